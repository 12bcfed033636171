"""`millrace worker --stay`: one worker serves one learner after another."""

from __future__ import annotations

import signal
from pathlib import Path

import psutil

from tests.system.stage.processes import START_S, TOY, Stage, Worker, wait_for

IDENTITY = "tests.support.envs.toy:Identity-v0"


def waits(worker: Worker, runs: int) -> psutil.Process:
    """The process that waits for the next learner, after so many runs."""
    worker.hears("waiting for a learner", START_S, times=runs + 1)
    wait_for(lambda: len(worker.processes()) == 2, START_S, "a process that waits")
    return worker.processes()[1]


def test_a_worker_serves_two_runs_of_other_environments_and_ends_with_sigterm(stage: Stage, tmp_path: Path) -> None:
    folder = tmp_path / "not-yet-there"
    address = f"ipc://{folder}/learner"
    worker = stage.worker(address, "robot", "--stay", "--join-timeout-s", "0.1")
    processes = [waits(worker, 0)]
    folder.mkdir()
    for number, (env, kwargs) in enumerate([(TOY, "seconds 0.001"), (IDENTITY, "")], start=1):
        learner = stage.learner(address, {"steps": 256, "env-kwargs": kwargs}, env=env)
        assert learner.ends(START_S) == 0, learner.said()
        assert "all steps done" in learner.said()
        processes.append(waits(worker, number))
    assert len(set(processes)) == 3, "every run has a process of its own"
    said = worker.said().splitlines()
    assert len(said) == 3, "it says nothing else"
    assert all("waiting for a learner at ipc://" in line for line in said)
    worker.signal(signal.SIGTERM)
    assert worker.ends() == 0
