"""The C++ client: its CartPole is gymnasium's, and a learner trains with it in both profiles."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from tests.system.processes import START_S, Running, Stage, free_port

pytestmark = pytest.mark.clients

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


def test_a_signal_drains_the_client(stage: Stage, cpp: Path) -> None:
    """SIGTERM: it says Goodbye, and ends with exit code 0; the learner waits for another."""
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address, "--inference", "learner", steps=1_000_000)
    client = stage.start([str(cpp / "cartpole"), address, "--name", "cpp0"], "cpp0")
    runs.hears("update", START_S)
    client.signal(signal.SIGTERM)
    assert client.ends() == 0
    assert "told to stop" in client.said()
    runs.hears("left: it was told to stop")
