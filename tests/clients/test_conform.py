"""`millrace conform`: our own worker and the clients in other languages conform."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from millrace.extras.conformance.conform import ClientCommand, _Process, conform
from millrace.extras.conformance.learner import Settings
from millrace.extras.conformance.profiles import PROFILES
from millrace.extras.conformance.report import explanation
from millrace.extras.conformance.script import Ended
from millrace.protocol.env_spec import EnvSpec
from tests.system.stage.processes import ROOT

WORKER = (sys.executable, "-m", "millrace", "worker", "{address}")
SHORT = {
    "environment": (
        "says Hello first, under its own name",
        "describes its environment on order",
        "begins a vector environment in the session in which it waited",
        "ends episodes, and resets a copy in the step after",
        "ignores what it cannot read: extra field, missing frame, unknown type",
        "drains while it steps",
    ),
    "collector": (
        "begins a run in the session in which it waited",
        "keeps the row format where episodes end",
        "sends a lost rollout again, the same",
        "closes a lane that is released while a ticket waits",
    ),
}

SKIPPED = {  # by clients in other languages
    "environment": ["resets a copy in the same step, or declines", "resets with options"],
    "collector": [
        "sets attributes of its environments",
        "continues the past of a lane, or says that it does not",
        "evaluates with rows, or declines",
        "evaluates under no other version, or declines rows",
    ],
}


@pytest.mark.parametrize("profile", SHORT)
def test_the_python_worker_passes_some_checks(profile: str) -> None:
    checks = [check for check in PROFILES[profile] if check.name in SHORT[profile]]
    results = conform(ClientCommand(WORKER), checks, Settings(EnvSpec("CartPole-v1")), 60.0, lambda result: None)
    assert [result.name for result in results] == list(SHORT[profile])
    assert [result.outcome for result in results] == ["passed"] * len(checks), [explanation(result) for result in results]


def test_a_client_that_has_just_ended_is_told_to_stop_without_an_error() -> None:
    with _Process(["true"], "", None) as process:
        process.start()
        assert process._running is not None
        os.waitid(os.P_PID, process._running.pid, os.WEXITED | os.WNOWAIT)
        process.ask_to_stop()
        assert process.ended() == Ended(0, "")


def command_of(client: str, request: pytest.FixtureRequest) -> tuple[str, ...]:
    """The client's command, without a token. Skips, with the reason, if the client cannot be built here."""
    match client:
        case "cpp":
            return (str(request.getfixturevalue("cpp") / "cartpole"), "{address}")
        case "cpp nim" | "cpp tag":
            return (str(request.getfixturevalue("cpp") / client[4:]), "{address}")
        case "js":
            return ("node", str(request.getfixturevalue("js") / "examples" / "cartpole.js"), "{address}")
    return WORKER  # it finds its token in the environment


AGENTS = "declines a run of agents that its environment does not have"


@pytest.mark.clients
@pytest.mark.parametrize("env", ["ChainGame", "ChainCrowd"])
def test_the_python_worker_keeps_the_rows_of_agents(env: str) -> None:
    names = ("keeps the row format where episodes end", AGENTS, "collects two lanes, and two tickets of one")
    checks = [check for check in PROFILES["collector"] if check.name in (*names, "evaluates with rows, or declines")]
    settings = Settings(EnvSpec(f"tests.support.users_code.seat_envs:{env}"))
    results = conform(ClientCommand(WORKER, with_keys=True), checks, settings, 60.0, lambda result: None)
    assert [result.outcome for result in results] == ["passed"] * 4, [explanation(result) for result in results]


@pytest.mark.clients
@pytest.mark.timeout(600)
@pytest.mark.parametrize("turns", ["wait", "ALL=1"])
def test_the_cpp_client_keeps_the_rows_of_agents_that_come_wait_and_leave(turns: str, cpp: Path) -> None:
    names = ("row format", "two lanes", "lost rollout", "evaluates", "agents")
    checks = [check for check in PROFILES["collector"] if any(name in check.name for name in names)]
    command = ("env", *([turns] if "=" in turns else []), str(cpp / "gathering"), "{address}")
    results = conform(ClientCommand(command), checks, Settings(EnvSpec("Gathering-v0")), 60.0, lambda result: None)
    unlike = {result.name: explanation(result) for result in results if result.outcome != "passed"}
    assert list(unlike) == [name for name in SKIPPED["collector"] if name.startswith("evaluates")], unlike


@pytest.mark.clients
@pytest.mark.timeout(600)
@pytest.mark.parametrize("high", [1, 255])
def test_the_cpp_client_divides_bytes_only_where_they_reach_from_0_to_255(high: int, cpp: Path) -> None:
    """The log-probabilities of its actions tell what its network has seen."""
    names = ("acts under the version that an order names", "acts by relu, and by normalized observations")
    checks = [check for check in PROFILES["collector"] if check.name.startswith(names)]
    command = ("env", f"HIGH={high}", str(cpp / "flags"), "{address}")
    results = conform(ClientCommand(command), checks, Settings(EnvSpec("Flags-v0")), 60.0, lambda result: None)
    assert [result.outcome for result in results] == ["passed"] * 2, [explanation(result) for result in results]


@pytest.mark.clients
@pytest.mark.timeout(1200)  # the first test of a client also waits for its build
@pytest.mark.parametrize(
    ("client", "profile", "keys"),
    [
        ("python", "environment", False),
        ("python", "collector", True),
        ("cpp", "environment", False),
        ("cpp", "collector", True),
        ("cpp nim", "collector", False),
        ("cpp tag", "collector", False),
        ("js", "environment", False),
        ("js", "environment", True),
    ],
)
def test_a_client_conforms(client: str, profile: str, keys: bool, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """The whole, from the command line; with keys, over an encrypted connection."""
    report = tmp_path / "report.json"
    flags = ["--profile", profile, "--patience-s", "20", "--limit-s", "500", "--json", str(report)]
    token = ["--token", "{token}"] if keys and client != "python" else []
    env = ["--env", f"{client[4:].title()}-v0"] if " " in client else []
    words = [*flags, *env, *(["--with-keys"] if keys else []), "--", *command_of(client, request), *token]
    command = [sys.executable, "-m", "millrace", "conform", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(report.read_text())
    assert found["conforms"]
    skipped = [check["name"] for check in found["checks"] if check["outcome"] == "skipped"]
    too_short = ["truncates an episode at the time limit"] if client == "cpp nim" else []
    assert skipped == ([] if client == "python" else too_short + SKIPPED[profile])
    assert len(found["checks"]) == len(PROFILES[profile])
