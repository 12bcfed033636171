"""One process trains a run at a time: real learners, one killed, one that is replaced, and runs that start together."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from learner.config.layers import resolve
from learner.run_folder.lease import Owner
from learner.run_folder.run_lock import LOCK_FILE
from millrace.launch.local_run import train
from tests.learner.config.test_on_resume import content
from tests.system.processes import START_S, Stage, free_port


@pytest.mark.soak
def test_a_second_learner_is_refused_a_killed_one_replaced_and_a_replaced_one_ends(stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    first = stage.learner(address, {"checkpoint-every-s": 0.3})
    stage.worker(address, "w0")
    first.trains(2)
    lock = first.folder / LOCK_FILE

    for command in (["learner"], ["millrace", "train"], ["millrace", "learner"]):
        second = stage.start([sys.executable, "-m", *command, "--resume", str(first.folder)], "second")
        assert second.ends(START_S) == 2, second.said()
        (line,) = second.said().splitlines()
        assert f"run {first.folder}: process {first.pid} on " in line
        assert f"is training it; wait until it ends, or end it (kill {first.pid}), then resume" in line
    first.trains(1)

    first.kill()
    assert lock.exists()
    third = stage.learner(address, resume=first.folder)
    third.hears(f"process {first.pid} on .* held its lock and is gone; this process takes over", START_S)
    third.trains(2)

    other = Owner(host="far", pid=77, boot="another kernel", token="theirs").encoded()
    lock.write_bytes(other)  # as if a process elsewhere had found this one dead
    assert third.ends(START_S) == 1, third.said()
    assert "process 77 on far has taken it over" in third.said().splitlines()[-1]
    assert lock.read_bytes() == other
    assert not (first.folder / "summary.json").exists(), "it wrote into a run that is not its own any more"


@pytest.mark.soak
def test_commands_that_read_a_run_need_no_lock(stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    learner = stage.learner(address)
    stage.worker(address, "w0")
    learner.trains(2)
    before = (learner.folder / LOCK_FILE).read_bytes()
    run = str(learner.folder)
    for command in (
        ["evaluate", run, "--episodes", "1", "--workers", "1"],
        ["report", run, "--out", f"{stage.tmp_path}/r.html"],
    ):
        reading = stage.start([sys.executable, "-m", "millrace", *command], command[0])
        assert reading.ends(START_S) == 0, reading.said()
    owner, now = before.split(b'"count"')[0], (learner.folder / LOCK_FILE).read_bytes().split(b'"count"')[0]
    assert owner == now
    learner.trains(1)


def test_four_runs_that_start_in_the_same_second_all_end_with_a_folder_of_their_own(tmp_path: Path) -> None:
    def run(number: int) -> Path:
        settings: dict[str, Any] = {"steps": 1_024, "rollout_steps": 64, "n_epochs": 1, "eval_episodes": 1, "net": (8,)}
        return train(
            resolve("CartPole-v1", transport="inproc", workers=1, run_dir=str(tmp_path / "runs"), **settings), None, print
        )

    with ThreadPoolExecutor(4) as threads:
        runs = list(threads.map(run, range(4)))
    assert len(set(runs)) == 4
    policies = {(path / "policy.safetensors").read_bytes() for path in runs}
    assert len(policies) == 1, "runs of one seed hurt each other"
    for path in runs:
        assert (path / "summary.json").is_file()
        assert LOCK_FILE not in content(path)
