"""`millrace conform`: our own worker conforms."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from learner.conformance.client.learner import Settings
from learner.conformance.client.profiles import PROFILES
from learner.conformance.client.report import explanation
from millrace.conform import Client, conform
from protocol.env_spec import EnvSpec
from tests.system.processes import ROOT

WORKER = (sys.executable, "-m", "millrace", "worker", "{address}")
SHORT = {
    "environment": (
        "says Hello first, under its own name",
        "describes its environment, with every Heartbeat",
        "ends episodes, and resets a copy in the step after",
        "ignores what it cannot read: extra field, missing frame, unknown type",
        "drains while it steps",
    ),
    "collector": (
        "keeps the row format where episodes end",
        "sends a lost rollout again, the same",
        "closes a lane that is released while a ticket waits",
        "forgets the session before",
        "drains while it collects",
    ),
}


@pytest.mark.parametrize("profile", SHORT)
def test_the_python_worker_passes_five_checks(profile: str) -> None:
    checks = [check for check in PROFILES[profile] if check.name in SHORT[profile]]
    results = conform(Client(WORKER), checks, Settings(EnvSpec("CartPole-v1")), 60.0, lambda result: None)
    assert [result.name for result in results] == list(SHORT[profile])
    assert [result.outcome for result in results] == ["passed"] * 5, [explanation(result) for result in results]


@pytest.mark.clients
@pytest.mark.timeout(300)
@pytest.mark.parametrize("profile", PROFILES)
def test_the_python_worker_conforms(profile: str, tmp_path: Path) -> None:
    """The whole, from the command line, over an encrypted connection."""
    report = tmp_path / "report.json"
    command = [sys.executable, "-m", "millrace", "conform", "--profile", profile, "--with-keys", "--json", str(report)]
    done = subprocess.run([*command, "--", *WORKER], cwd=ROOT, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{len(PROFILES[profile])} checks passed, 0 failed" in done.stdout
    assert '"conforms": true' in report.read_text()


@pytest.mark.clients
@pytest.mark.timeout(900)
@pytest.mark.parametrize("profile", PROFILES)
def test_the_cpp_client_conforms(profile: str, cpp: Path) -> None:
    client = Client((str(cpp / "cartpole"), "{address}", "--token", "{token}"))
    results = conform(client, PROFILES[profile], Settings(EnvSpec("CartPole-v1")), 200.0, lambda result: None)
    failed = [line for each in results if each.outcome == "failed" for line in (each.name, *explanation(each))]
    assert not failed, "\n".join(failed)
