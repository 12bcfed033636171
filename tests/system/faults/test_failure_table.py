"""A learner and its workers as real processes over TCP, with one fault in each test.

Each test injects a fault, checks the learner's log, and prints how long it took until training went on. At the end every
ticket and every transition must be accounted for. Network faults are in `test_network_faults.py`.
"""

from __future__ import annotations

import fcntl
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

from millrace.workers.machine_slots import FILE_VARIABLE
from tests.system.stage.preloaded import workers_of
from tests.system.stage.processes import START_S, TOY, WORKER_TIMEOUT_S, Learner, Stage, free_port, wait_for
from tests.system.stage.runs import IN_ROLLOUT, LANES, NOTICED_S, accounted, dealt_again, finish, play, within
from tests.system.stage.small_disk import filled, small_disk

FRAMES = "tests.support.envs.toy:Frames-v0"
LOCAL = {"transport": "tcp", "rollout-steps": 16, "batch-size": 64, "n-epochs": 1, "eval-episodes": 1}
LOCAL_FLAGS = [
    *("--env-kwargs", "seconds", "0.005"),
    *(word for name, value in LOCAL.items() for word in (f"--{name}", str(value))),
]
"""of a run whose workers are child processes of the learner"""

# ---------------------------------------------------------------- workers


def test_training_goes_on_after_a_worker_is_killed(stage: Stage) -> None:
    learner, (victim, other) = play(stage, IN_ROLLOUT)
    victim.kill()
    within("worker killed -9, elsewhere", dealt_again(learner), NOTICED_S)
    learner.hears(r"worker w0 silent for 2 s; \d of its tickets are dealt again")
    learner.trains()
    ledger = finish(learner, [other])
    assert ledger["transitions_late"] == ledger["transitions_invalid"] == 0, "half a rollout was seen"


def test_a_killed_worker_of_a_local_run_is_restarted(stage: Stage) -> None:
    """The worker is a child process of the learner, which notices its death at once and restarts it."""
    command = [sys.executable, "-m", "millrace", "train", TOY, *LOCAL_FLAGS]
    said = stage.tmp_path / "train.log"
    learner = Learner([*command, "--run-dir", str(stage.runs)], said, stage.runs)
    stage.started.append(learner)
    learner.trains(2)
    victim = workers_of(learner.pid)[0]
    victim.kill()
    within("worker killed -9, on the learner's machine", dealt_again(learner), 1.0)
    learner.trains()
    wait_for(lambda: len(workers_of(learner.pid)) == 2, START_S, "the worker's return")
    finish(learner, [])


def test_a_run_whose_file_of_slots_is_locked_ends_and_names_the_file(stage: Stage) -> None:
    path = os.environ[FILE_VARIABLE]
    with open(path, "w") as file:
        fcntl.lockf(file, fcntl.LOCK_EX)
        ended = subprocess.run(
            [sys.executable, "-m", "millrace", "train", TOY, "--run-dir", str(stage.runs)],
            capture_output=True,
            text=True,
            timeout=START_S,
        )
    assert ended.returncode == 2, ended.stderr
    assert f"has locked all of {path}, a file of user " in ended.stderr


def test_a_stopped_worker_joins_again_when_it_continues(stage: Stage) -> None:
    """The worker is stopped in the one long step of its rollout. When it continues, its rollout comes too late."""
    one_step = {"env-kwargs": "seconds 0.4", "rollout-steps": 1, "envs": 2, "lanes": 2, "batch-size": 2}
    learner, (stopped, other) = play(stage, one_step)
    time.sleep(0.1)  # after an update, so that both workers are in their next step
    stopped.pause()
    within("worker stopped", dealt_again(learner), NOTICED_S)
    learner.hears(r"worker w0 silent for 2 s; \d of its tickets are dealt again")
    stopped.go_on()
    began_s = time.monotonic()
    learner.hears(r"worker w0 \(.*\) joined", times=2)
    within("worker continued, joined again", time.monotonic() - began_s, 2.0)
    learner.trains()
    ledger = finish(learner, [stopped, other], lanes=2, rows=1)
    assert ledger["transitions_late"] > 0, "its late rollout was not counted"


def test_a_run_without_workers_saves_a_checkpoint_and_fails(stage: Stage) -> None:
    learner, workers = play(stage, {"no-workers-timeout-s": 1, **IN_ROLLOUT})
    for worker in workers:
        worker.kill()
    began_s = time.monotonic()
    assert learner.ends() == 1
    within("all workers gone, the run ended", time.monotonic() - began_s, NOTICED_S + 2)
    assert "waited 1 s for 1 worker at tcp://127.0.0.1:" in learner.said().splitlines()[-1]
    summary = learner.summary()
    assert "waited 1 s for 1 worker" in summary["stop_reason"]
    assert int(learner.checkpoints()[-1].stem) == summary["env_steps"], "the last update was not saved"
    ledger = accounted(summary)
    assert ledger["lost"] > 0


def test_a_local_run_ends_at_once_when_its_last_worker_has_left(stage: Stage) -> None:
    command = [sys.executable, "-m", "millrace", "train", TOY, *LOCAL_FLAGS, "--run-dir", str(stage.runs)]
    learner = Learner([*command, "--workers", "1"], stage.tmp_path / "train.log", stage.runs)
    stage.started.append(learner)
    learner.trains(2)
    os.kill(workers_of(learner.pid)[0].pid, signal.SIGTERM)
    began_s = time.monotonic()
    assert learner.ends() == 1
    within("the only worker asked to leave, the run ended", time.monotonic() - began_s, NOTICED_S + 2)
    why = "no worker is left, and none will be started again: the last one left: told to stop"
    assert why in learner.said().splitlines()[-1]
    assert int(learner.checkpoints()[-1].stem) == learner.summary()["env_steps"], "the last update was not saved"


def test_a_local_run_whose_workers_cannot_start_ends_with_what_they_wrote(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\nif 'millrace.workers' in sys.orig_argv:\n    raise SystemExit('no licence')\n"
    )
    command = [sys.executable, "-m", "millrace", "train", TOY, "--workers", "1", "--run-dir", str(tmp_path / "runs")]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=START_S)
    assert run.returncode == 1
    assert run.stdout.count("worker w0 ended with exit code 1 while it started (SystemExit: no licence)") == 4
    assert "\n    SystemExit: no licence\n" in run.stdout
    last = run.stderr.splitlines()[-1]
    assert last.startswith(
        "millrace: no worker is left, and none will be started again: the last one ended with exit code 1"
    )


def test_a_worker_delivers_its_rollout_after_sigterm(stage: Stage) -> None:
    """The unfinished rollout is delivered. Only tickets whose rollouts had not begun are lost."""
    learner, (leaver, other) = play(stage, IN_ROLLOUT)
    leaver.signal(signal.SIGTERM)
    began_s = time.monotonic()
    assert leaver.ends() == 0, leaver.said()
    learner.hears("worker w0 left: told to stop")
    learner.trains(1)
    within("SIGTERM to a worker", time.monotonic() - began_s, 2.0)
    lost = learner.ledger()["lost"]
    began_s = time.monotonic()
    ledger = finish(learner, [other])
    within("SIGTERM to the learner, everybody gone", time.monotonic() - began_s, 4.0)
    assert ledger["lost"] - lost <= LANES
    assert ledger["transitions_late"] == 0
    assert int(learner.checkpoints()[-1].stem) == learner.summary()["env_steps"], "the last update was not saved"
    assert re.search("continue with: .*millrace learner --resume", learner.said().splitlines()[-1])


# ---------------------------------------------------------------- the learner


def test_workers_join_a_resumed_learner_on_the_same_port(stage: Stage) -> None:
    """The workers finish packed rollouts while there is no learner. These arrive before the workers have joined again."""
    keys, token = stage.keys()  # so that rollouts are packed
    packed = {"keys": keys, "max-lag": 1, "env-kwargs": ""}
    address = f"tcp://127.0.0.1:{free_port()}"
    killed = stage.learner(address, {"min-workers": 2, "checkpoint-every-s": 0.3, **packed}, env=FRAMES)
    workers = [stage.worker(address, f"w{number}", "--token", str(token)) for number in range(2)]
    wait_for(lambda: len(killed.checkpoints()) >= 3, START_S, "the third checkpoint")
    killed.kill()
    seen = killed.rows()[-1]["time/total_timesteps"]  # its last rows may be newer than its last checkpoint
    learner = stage.learner(address, resume=killed.folder)
    learner.is_open()
    seconds = learner.until(
        lambda row: row["time/total_timesteps"] > seen, START_S, "an update after those of the first learner"
    )
    within("learner killed -9 and resumed", seconds, 5.0)
    learner.trains()
    assert all(worker.alive() for worker in workers), "a worker had to be restarted"
    steps = [row["time/total_timesteps"] for row in learner.rows()]
    assert steps == sorted(set(steps)), "the curve goes over the same steps twice"
    finish(learner, workers, max_lag=1)


def test_a_slow_learner_loses_no_worker(stage: Stage) -> None:
    """The learner is stopped for longer than worker_timeout_s. Tickets run out, no queue grows, and no worker is removed."""
    learner, workers = play(stage)
    before = [worker.memory_mb() for worker in workers]
    learner.pause()
    time.sleep(WORKER_TIMEOUT_S + 0.5)
    grown = [worker.memory_mb() - then for worker, then in zip(workers, before, strict=True)]
    learner.go_on()
    began_s = time.monotonic()
    learner.trains(1)
    within("learner stopped for 2 s", time.monotonic() - began_s, 1.0)
    assert max(grown) < 5, f"workers grew by {grown} MB"
    learner.trains()
    assert learner.ledger()["lost"] == 0, "a worker was given up while it was the learner that was slow"
    assert "silent" not in learner.said()
    finish(learner, workers)


# ---------------------------------------------------------------- what breaks by itself


def test_training_goes_on_after_an_environment_raised(stage: Stage) -> None:
    once = stage.tmp_path / "raised"
    settings = {"env-kwargs": f"once {once} after 300"}
    learner, workers = play(stage, settings, env="tests.support.envs.toy:Raises-v0")
    learner.hears("ValueError: the toy is broken, as it was asked to be")
    began_s = time.monotonic()
    assert "toy.py" in learner.said(), "the traceback is not the worker's"
    learner.trains(2)
    within("env.step raised", time.monotonic() - began_s, 2.0)
    assert learner.ledger()["lost"] > 0
    learner.hears(r"worker w\d \(.*\) joined", START_S, times=3)  # its supervisor has started another
    finish(learner, workers)


def test_training_goes_on_after_an_environment_hung(stage: Stage) -> None:
    """The worker's supervisor says that it is alive, and ends it when the run's step timeout has passed: the run's alone."""
    address = f"tcp://127.0.0.1:{free_port()}"
    began = stage.tmp_path / "hung"
    settings = {"min-workers": 2, "env-kwargs": f"once {began} after 300", "step-timeout-s": 1.5}
    learner = stage.learner(address, settings, env="tests.support.envs.toy:Hangs-v0")
    workers = [stage.worker(address, f"w{number}") for number in range(2)]
    learner.until(lambda row: row["ledger/lost"] > 0, START_S, "an update with tickets dealt again")
    within("env.step hung, step timeout 1.5 s", time.time() - began.stat().st_mtime, 1.5 + 1)
    learner.hears(
        r"its process was ended: a step of its environment took longer than 1.5 s \(--step-timeout-s\), at .*toy.py"
    )
    assert "silent" not in learner.said()
    assert any("toy.py" in worker.said() for worker in workers), "it does not say where it hung"
    learner.trains()
    learner.hears(r"worker w\d \(.*\) joined", START_S, times=3)  # its supervisor has started another
    finish(learner, workers)


def test_training_goes_on_while_the_disk_is_full(stage: Stage) -> None:
    """The old checkpoints stay whole, and training goes on with a warning each time. When there is space, it saves again."""
    with small_disk(stage.tmp_path / "disk") as disk:
        stage.runs = disk / "runs"
        learner, workers = play(stage, {"checkpoint-every-s": 0.3})
        wait_for(lambda: len(learner.checkpoints()) >= 2, START_S, "the second checkpoint")
        filler = filled(disk)
        trained = learner.updates()
        learner.hears("checkpoint .* not written: No space left on device; older checkpoints are untouched", times=2)
        saved = learner.checkpoints()
        assert saved
        assert not list(disk.rglob("*.tmp")), "half a file was left"
        filler.unlink()
        began_s = time.monotonic()
        learner.trains(1)
        within("disk full, then not, written again", time.monotonic() - began_s, 1.0)
        assert learner.updates() > trained + 2, "training stood still"
        wait_for(lambda: learner.checkpoints()[-1] not in saved, START_S, "a checkpoint after those")
        finish(learner, workers)
