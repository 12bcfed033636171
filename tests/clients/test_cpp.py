"""The C++ client: its CartPole is gymnasium's, and a learner trains with it in both profiles."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from millrace.learner.run_folder.metrics_log import read_rows
from millrace.protocol.messages import PROTOCOL_VERSION, Drain, Refuse
from millrace.protocol.wire.codec import encode
from tests.clients.messages_to_clients import corpus
from tests.clients.programs import FalseLearner
from tests.system.stage.processes import START_S, Running, Stage, free_port, wait_for
from tests.system.stage.run_folders import policy_of

pytestmark = [pytest.mark.clients, pytest.mark.timeout(600)]  # the first test also waits for the compiler

Row = tuple[list[str], float, bool, bool]
"""observation as hexadecimal floats, reward, terminated, truncated"""


def learner(stage: Stage, address: str, *flags: str, steps: int = 4_000, env: str = "CartPole-v1") -> Running:
    """Start `millrace learner` at this address."""
    command = [sys.executable, "-m", "millrace", "learner", env, "--bind", address, "--run-dir", str(stage.runs)]
    settings = ["--preset", "none", "--steps", str(steps), "--eval-episodes", "2", *flags]
    return stage.start([*command, *settings], "learner")


def ends_well(running: Running, within_s: float = 120.0) -> str:
    """Wait until it ends with exit code 0. Returns what it said."""
    assert running.ends(within_s) == 0, running.said()
    return running.said()


def folder(stage: Stage) -> Path:
    (found,) = stage.runs.iterdir()
    return found


def summary(stage: Stage) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder(stage) / "summary.json").read_text())
    return found


def updates(stage: Stage) -> int:
    """Number of updates so far."""
    rows = read_rows(folder(stage) / "metrics.jsonl")
    return int(rows[-1]["time/iterations"]) if rows else 0


# ---------------------------------------------------------------- the environment


def gymnasium_rows(start: Sequence[float], actions: Sequence[int]) -> list[Row]:
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=0)
    env.unwrapped.state = np.array(start)  # type: ignore[attr-defined]
    rows: list[Row] = []
    for action in actions:
        obs, reward, terminated, truncated, _ = env.step(action)
        rows.append(([float(each).hex() for each in obs], float(reward), terminated, truncated))
        if terminated or truncated:
            break
    return rows


def balancing(start: Sequence[float]) -> list[int]:
    """Actions that keep the pole up for 500 steps."""
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=0)
    env.unwrapped.state = np.array(start)  # type: ignore[attr-defined]
    obs, actions = np.array(start), []
    for _ in range(500):
        actions.append(int(0.1 * obs[0] + 0.3 * obs[1] + 3 * obs[2] + obs[3] > 0))
        obs = env.step(actions[-1])[0]
    return actions


def test_cartpole_gives_gymnasiums_bits(cpp: Path) -> None:
    """Same start state and actions: same observations, rewards and ends, also at the time limit, which truncates."""
    rng = np.random.default_rng(1)
    episodes = [(list(rng.uniform(-0.05, 0.05, 4)), [int(a) for a in rng.integers(0, 2, 200)]) for _ in range(200)]
    episodes += [(start := list(rng.uniform(-0.05, 0.05, 4)), balancing(start)) for _ in range(20)]
    expected = [gymnasium_rows(*episode) for episode in episodes]
    lines = [
        " ".join([*(float(x).hex() for x in start), str(len(rows)), *map(str, actions[: len(rows)])])
        for (start, actions), rows in zip(episodes, expected, strict=True)
    ]
    done = subprocess.run([cpp / "trace"], input="\n".join(lines), capture_output=True, text=True, timeout=60, check=True)
    got = []
    for line in done.stdout.splitlines():
        *obs, reward, terminated, truncated = line.split()
        got.append(([float.fromhex(each).hex() for each in obs], float(reward), terminated == "1", truncated == "1"))
    assert got == [row for rows in expected for row in rows]
    assert sum(row[3] and not row[2] for row in got) == 20  # those that stood for 500 steps
    assert sum(row[2] for row in got) == 200


# ---------------------------------------------------------------- the environment profile


def test_the_learner_acts_and_the_client_steps(stage: Stage, cpp: Path) -> None:
    """The client describes the environment, steps all lanes, is evaluated, and leaves with exit code 0 at the end."""
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address, "--inference", "learner")
    client = stage.start([str(cpp / "cartpole"), address, "--name", "cpp0"], "cpp0")
    assert "greedy return" in ends_well(runs, START_S + 60)
    assert "the vector environment was closed" in ends_well(client)


def test_the_weights_are_those_of_a_python_worker(stage: Stage, cpp: Path) -> None:
    """Bit for bit, in the environment profile: dynamics and random numbers are gymnasium's."""
    policies = []
    for name in ("cpp", "python"):
        address = f"tcp://127.0.0.1:{free_port()}"
        runs = learner(stage, address, "--inference", "learner", "--run-dir", str(stage.tmp_path / name))
        if name == "cpp":
            worker: Running = stage.start([str(cpp / "cartpole"), address, "--name", name], name)
        else:
            worker = stage.worker(address, name)
        ends_well(runs, START_S + 60)
        ends_well(worker)
        (found,) = (stage.tmp_path / name).iterdir()
        evaluation = json.loads((found / "summary.json").read_text())["evaluation"]
        policies.append((policy_of(found), evaluation))
    assert policies[0] == policies[1]


# ---------------------------------------------------------------- the collector profile


@pytest.mark.parametrize(
    ("env", "program"),
    [("CartPole-v1", "cartpole"), ("Pendulum-v1", "pendulum"), ("Tag-v0", "tag"), ("Gathering-v0", "gathering")],
)
@pytest.mark.parametrize("normalize", [False, True])
def test_the_client_acts_as_the_learner_would(stage: Stage, cpp: Path, env: str, program: str, normalize: bool) -> None:
    """With one gradient step for each update, the policy that acted is the learner's, but for rounding."""
    address = f"tcp://127.0.0.1:{free_port()}"
    flags = ["--n-epochs", "1", "--batch-size", "100000", *(["--normalize-observations"] if normalize else [])]
    runs = learner(stage, address, *flags, steps=10_000, env=env)
    client = stage.start([str(cpp / program), address, "--name", "cpp0"], "cpp0")
    ends_well(runs, START_S + 60)
    ends_well(client)
    rows = read_rows(folder(stage) / "metrics.jsonl")
    assert len(rows) >= 5
    assert max(abs(row["train/approx_kl"]) for row in rows) < 1e-6
    assert max(abs(row["train/clip_fraction"]) for row in rows) == 0
    ledger = summary(stage)["ledger"]
    assert ledger["transitions_invalid"] == ledger["messages_bad"] == ledger["transitions_duplicate"] == 0
    assert ledger["transitions_used"] == ledger["transitions_received"]
    assert summary(stage)["evaluation"]["episodes"] == 2


def test_weights_of_two_bytes(stage: Stage, cpp: Path) -> None:
    """bfloat16 weights: the client acts with exactly what was sent."""
    address = f"tcp://127.0.0.1:{free_port()}"
    flags = ["--n-epochs", "1", "--batch-size", "100000", "--acting-dtype", "bfloat16"]
    runs = learner(stage, address, *flags, steps=3_000)
    client = stage.start([str(cpp / "cartpole"), address, "--name", "cpp0"], "cpp0")
    ends_well(runs, START_S + 60)
    ends_well(client)
    assert max(abs(row["train/approx_kl"]) for row in read_rows(folder(stage) / "metrics.jsonl")) < 1e-3


def test_a_program_that_owns_its_loop_learns_and_counts_late_actions(stage: Stage, cpp: Path) -> None:
    """Late actions are not learned from, and every rollout that holds them keeps the row format."""
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address, "--envs", "1", "--lanes", "1", "--rollout-steps", "64", steps=1_500)
    command = [str(cpp / "control_50hz"), address, "--name", "robot", "--hz", "1000", "--deadline-ms", "0.02"]
    robot = stage.start(command, "robot")
    ends_well(runs, START_S + 120)
    said = ends_well(robot)
    found = re.search(r"(\d+) steps, (\d+) of them recorded; (\d+) late", said)
    assert found is not None, said
    steps, recorded, late = map(int, found.groups())
    ledger = summary(stage)["ledger"]
    assert ledger["transitions_invalid"] == ledger["messages_bad"] == 0
    assert 1_000 < ledger["transitions_used"] <= recorded < steps
    assert 0 < ledger["late_actions"] <= late


def test_two_copies_are_too_many_for_a_program_that_owns_its_loop(stage: Stage, cpp: Path) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    learner(stage, address, "--envs", "2", "--lanes", "1")
    robot = stage.start([str(cpp / "control_50hz"), address, "--name", "robot"], "robot")
    assert robot.ends(START_S) == 2
    assert "this client has one env copy, the learner asks for 2" in robot.said()


# ---------------------------------------------------------------- joining and leaving


def test_a_token_opens_the_door_and_its_end_closes_it(stage: Stage, cpp: Path) -> None:
    """A client with a token joins; one without is told why not; a revoked one leaves with exit code 2 and the reason."""
    keys = stage.tmp_path / "keys"
    address = f"tcp://127.0.0.1:{free_port()}"
    manage = [sys.executable, "-m", "millrace", "keys"]
    for name in ("lab", "other"):
        subprocess.run([*manage, "new", name, "--keys", str(keys)], check=True, capture_output=True, timeout=60)
    runs = learner(stage, address, "--keys", str(keys), steps=10_000_000)
    lab = stage.start([str(cpp / "cartpole"), address, "--name", "lab", "--token", str(keys / "lab.token")], "lab")
    kept = stage.start([str(cpp / "cartpole"), address, "--name", "kept", "--token", str(keys / "other.token")], "kept")
    for client in (lab, kept):
        client.hears(": joined", START_S)
    runs.hears("workers 2", START_S)
    bare = stage.start([str(cpp / "cartpole"), address, "--name", "bare", "--join-timeout-s", "3"], "bare")
    assert bare.ends() == 1
    assert "perhaps it asks for a token" in bare.said()
    runs.hears("update", START_S)
    subprocess.run([*manage, "revoke", "lab", "--keys", str(keys)], check=True, capture_output=True, timeout=60)
    assert lab.ends() == 2
    assert "revoked" in lab.said()
    late = stage.tmp_path / "late.token"
    late.touch(mode=0o600)
    late.write_text((keys / "other.token").read_text())
    subprocess.run([*manage, "revoke", "other", "--keys", str(keys)], check=True, capture_output=True, timeout=60)
    assert kept.ends() == 2
    again = stage.start([str(cpp / "cartpole"), address, "--name", "again", "--token", str(late)], "again")
    assert again.ends() == 2
    assert "refused this client's key" in again.said()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("millrace1.short", "expected 101 characters of a join token, got 15"),
        ("rubbish", "expected one line that begins with millrace1."),
        ("millrace1." + "A" * 91, "a character of it is wrong"),
    ],
)
def test_a_damaged_token_is_named_in_one_line(stage: Stage, cpp: Path, text: str, said: str) -> None:
    token = stage.tmp_path / "damaged.token"
    token.write_text(text + "\n")
    client = stage.start([str(cpp / "cartpole"), "tcp://127.0.0.1:9", "--token", str(token)], "damaged")
    assert client.ends() == 2
    (line,) = client.said().splitlines()
    assert said in line


def test_another_environment_is_declined_with_the_reason(stage: Stage, cpp: Path) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address, env="Pendulum-v1")
    client = stage.start([str(cpp / "cartpole"), address, "--name", "cpp0"], "cpp0")
    assert client.ends(START_S) == 2
    assert "this client has the environment CartPole-v1, the learner asks for Pendulum-v1" in client.said()
    runs.hears("the learner asks for Pendulum-v1")


@pytest.mark.parametrize(
    ("answer", "code"), [(Refuse("protocol: expected 5, got 4; install version 5"), 2), (Drain("the run is over"), 0)]
)
def test_a_refusal_and_a_drain_are_printed(stage: Stage, cpp: Path, answer: Refuse | Drain, code: int) -> None:
    """Refuse: exit code 2 with the learner's reason. Drain while it joins: exit code 0. An unreadable message: no harm."""
    with FalseLearner() as false:
        client = stage.start([str(cpp / "cartpole"), false.address, "--name", "cpp0"], "cpp0")
        peer, hello = false.hello()
        assert (peer, hello.worker, hello.protocol) == (b"cpp0", "cpp0", PROTOCOL_VERSION)
        assert hello.attempt == hello.process_nonce + 1
        assert false.hello()[1] == hello  # repeated, with the same number
        false.socket.send_multipart([peer, b"\x92\xa4Nope\x01"])
        false.socket.send_multipart([peer, *encode(answer)])
        assert client.ends() == code
        assert answer.reason in client.said()
        assert "cannot be used" in client.said()


@pytest.mark.parametrize("profile", ["workers", "learner"])
def test_the_client_joins_a_learner_that_was_started_again(stage: Stage, cpp: Path, profile: str) -> None:
    """A killed learner is started again with --resume: the client joins it, and the run goes on."""
    address = f"tcp://127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "millrace", "learner", "--bind", address]
    flags = ["--checkpoint-every-s", "0", "--worker-timeout-s", "2", "--inference", profile]
    runs = learner(stage, address, *flags, steps=10_000_000)
    client = stage.start([str(cpp / "cartpole"), address, "--name", "cpp0"], "cpp0")
    runs.hears(r"update [1-9]\d*", START_S)
    runs.kill()
    before = updates(stage)
    again = stage.start([*command, "--resume", str(folder(stage))], "again")
    wait_for(lambda: updates(stage) > before + 1, START_S, again.said)
    again.signal(signal.SIGINT)
    again.ends(60)
    assert client.ends() == 0, client.said()
    assert "joining again" in client.said()


def test_two_clients_and_a_python_worker_together(stage: Stage, cpp: Path) -> None:
    """Environment profile: the three step copies of one vector environment, and the run ends well for all."""
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(
        stage, address, "--inference", "learner", "--min-workers", "3", "--lanes", "6", "--envs", "12", steps=12_000
    )
    clients = [stage.start([str(cpp / "cartpole"), address, "--name", name], name) for name in ("cpp0", "cpp1")]
    worker = stage.worker(address, "python0")
    ends_well(runs, START_S + 90)
    for each in (*clients, worker):
        ends_well(each)
    assert summary(stage)["ledger"]["lost"] == 0
    assert all(": joined" in client.said() for client in clients)
    assert "workers 3" in runs.said()


def test_a_signal_drains_the_client(stage: Stage, cpp: Path) -> None:
    """SIGTERM: it says Goodbye, and ends with exit code 0; the learner waits for another."""
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address, "--inference", "learner", steps=1_000_000)
    client = stage.start([str(cpp / "cartpole"), address, "--name", "cpp0"], "cpp0")
    runs.hears("update", START_S)

    def status() -> dict[str, Any]:
        asked = [sys.executable, "-m", "millrace", "status", address, "--json"]
        (found,) = json.loads(subprocess.run(asked, capture_output=True, timeout=60, check=True).stdout)["workers"]
        return dict(found)

    wait_for(lambda: status()["doing"], START_S, "an Alive of the client")
    worker = status()
    assert worker["worker"] == "cpp0"
    assert worker["doing"] in ("waiting", "stepping", "resetting")
    assert worker["steps"] > 0
    assert worker["resident_bytes"] > 1e6
    client.signal(signal.SIGTERM)
    assert client.ends() == 0
    assert "told to stop" in client.said()
    runs.hears("left: it was told to stop")


# ---------------------------------------------------------------- hostile messages


@pytest.mark.parametrize("client", ["worker", "agent"])
def test_a_hundred_thousand_mutated_messages_do_no_harm(cpp: Path, tmp_path: Path, client: str) -> None:
    """Built with the address and undefined-behaviour sanitizers, a client takes each of them: a worker in both profiles."""
    (tmp_path / "corpus").write_bytes(corpus(1 if client == "agent" else 2))
    command = [str(cpp / "fuzz"), str(tmp_path / "corpus"), "100000", client]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-4000:]
    read, unreadable = map(int, re.findall(r"\d+", done.stdout))
    assert read + unreadable == 100_000
    assert read > 10_000  # so many still were messages, and were obeyed
    assert unreadable > 10_000


# ---------------------------------------------------------------- memory


def test_a_step_allocates_nothing(cpp: Path, tmp_path: Path) -> None:
    """After some to warm up: none for a step of the environment profile; one for a rollout (its ticket), however long."""
    (tmp_path / "corpus").write_bytes(corpus())
    done = subprocess.run([cpp / "allocations", tmp_path / "corpus"], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["0", "1"]
