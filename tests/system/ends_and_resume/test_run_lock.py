"""One process trains a run at a time: real learners, one killed, one that is replaced, and runs that start together.

Machines that share a folder are processes here. Each has its own host name, its own boot id of the kernel and its own mount
point of the folder (namespaces), and no system lock. So only the lease decides between them.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.lease import Owner
from millrace.learner.run_folder.run_lock import LOCK_FILE
from tests.learner.config.test_resume_rules import content
from tests.system.stage.processes import SMALL, START_S, TOY, Learner, Stage, free_port
from tests.system.stage.run_folders import policy_of

WITHOUT_FLOCK = """
import errno, fcntl, runpy, sys

def flock(file, operation):
    raise OSError(errno.ENOLCK, "No locks available")

fcntl.flock = flock
sys.argv = ["millrace", "learner", *sys.argv[1:]]
runpy.run_module("millrace", run_name="__main__", alter_sys=True)
"""
AS_MACHINE = 'mount --bind "$1" /proc/sys/kernel/random/boot_id; hostname "$2"; mount --bind "$3" "$4"; shift 4; exec "$@"'


class Machine:
    """A machine of its own, as far as the run lock can tell, which mounts the shared folder."""

    def __init__(self, stage: Stage, name: str) -> None:
        self._stage, self._name = stage, name
        self._boot, self._mounted = stage.tmp_path / f"boot-{name}", stage.tmp_path / f"mounted-{name}"
        self._boot.write_text(f"kernel-of-{name}\n")
        self._mounted.mkdir()

    def learner(self, *arguments: object, resume: Path | None = None) -> Learner:
        """Start a learner. Returns it with the shared folder as this test sees it."""
        stage = self._stage
        stage.runs.mkdir(exist_ok=True)
        if resume is None:
            arguments = (TOY, "--run-dir", self._mounted, *arguments)
        else:
            arguments = ("--resume", self._mounted / resume.name, *arguments)
        machine = ["unshare", "--mount", "--uts", "sh", "-ec", AS_MACHINE, "sh"]
        machine += [str(self._boot), self._name, str(stage.runs), str(self._mounted)]
        command = [*machine, sys.executable, "-c", WITHOUT_FLOCK, *map(str, arguments)]
        made = Learner(command, stage.tmp_path / f"{self._name}-{len(stage.started)}.log", stage.runs)
        stage.started.append(made)
        return made


@pytest.mark.soak
@pytest.mark.skipif(os.geteuid() != 0, reason="mount namespaces take root")
def test_machines_that_share_a_folder_without_system_locks_judge_by_the_lease(stage: Stage) -> None:
    """The owner lives: refused. It is killed: taken over after 30 s. It is stopped for so long: it ends when it goes on."""
    ports = [free_port() for _ in range(2)]
    settings = [word for name, value in SMALL.items() for word in (f"--{name}", *str(value).split())]
    one, two, three = (Machine(stage, name) for name in ("one", "two", "three"))

    first = one.learner("--bind", f"tcp://127.0.0.1:{ports[0]}", *settings, "--checkpoint-every-s", 0.3)
    worker = stage.worker(f"tcp://127.0.0.1:{ports[0]}", "w0")
    first.trains(2)
    began_s = time.monotonic()
    refused = two.learner(resume=first.folder)
    assert refused.ends(START_S) == 2, refused.said()
    assert time.monotonic() - began_s < START_S
    assert f"process {first.pid} on one is training it" in refused.said()
    assert "takes over" not in refused.said()
    first.trains(1)

    first.kill()
    began_s = time.monotonic()
    second = two.learner(resume=first.folder)
    second.hears(f"its lock names process {first.pid} on one; waiting up to 30 s", START_S)
    second.hears(f"process {first.pid} on one held its lock and is gone; this process takes over", START_S)
    assert time.monotonic() - began_s > 29.0
    second.trains(2)

    second.pause()
    third = three.learner("--bind", f"tcp://127.0.0.1:{ports[1]}", resume=first.folder)
    third.hears(f"process {second.pid} on two held its lock and is gone; this process takes over", START_S)
    stage.worker(f"tcp://127.0.0.1:{ports[1]}", "w1")
    third.trains(2)
    second.go_on()
    assert second.ends(START_S) == 1, second.said()
    assert f"process {third.pid} on three took it over" in second.said().splitlines()[-1]
    assert not (first.folder / "summary.json").exists(), "it wrote into a run that is not its own any more"
    third.trains(2)
    third.signal(signal.SIGTERM)
    assert third.ends() == 130, third.said()
    steps = [row["time/total_timesteps"] for row in third.rows()]
    assert steps == sorted(set(steps)), "two learners wrote rows"
    assert LOCK_FILE not in content(first.folder)
    worker.kill()


@pytest.mark.soak
def test_a_second_learner_is_refused_a_killed_one_replaced_and_a_replaced_one_ends(stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    first = stage.learner(address, {"checkpoint-every-s": 0.3})
    stage.worker(address, "w0")
    first.trains(2)
    lock = first.folder / LOCK_FILE

    for command in ("train", "learner"):
        second = stage.start([sys.executable, "-m", "millrace", command, "--resume", str(first.folder)], "second")
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

    other = Owner(host="far", pid=77, boot_id="another kernel", token="theirs").encoded()
    lock.write_bytes(other)  # as if a process elsewhere had found this one dead
    assert third.ends(START_S) == 1, third.said()
    assert "process 77 on far took it over" in third.said().splitlines()[-1]
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
    policies = {policy_of(path) for path in runs}
    assert len(policies) == 1, "runs of one seed hurt each other"
    for path in runs:
        assert (path / "summary.json").is_file()
        assert LOCK_FILE not in content(path)
