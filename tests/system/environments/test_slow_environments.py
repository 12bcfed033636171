"""Slow is not dead: environments whose calls take longer than the worker timeout train; those that hang or end are named.

Each test runs a learner and its workers as real processes.
"""

from __future__ import annotations

import itertools
import json
import re
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from unittest import mock

import psutil
import pytest

from millrace.launch import worker_pool
from millrace.learner.callbacks.callback import Callback
from millrace.protocol.machine.core_times import CoreTimes
from millrace.protocol.machine.cpu_cores import usable_cores
from tests.system.stage import preloaded
from tests.system.stage.preloaded import workers_of
from tests.system.stage.processes import ROOT, START_S, Learner, Running, Stage, free_port, wait_for
from tests.system.stage.runs import within

ENVS = "tests.system.environments.slow_envs"
SMALL: dict[str, object] = {
    "rollout-steps": 2,
    "envs": 2,
    "lanes": 2,
    "batch-size": 4,
    "n-epochs": 1,
    "eval-episodes": 1,
    "worker-timeout-s": 1,
    "steps": 1_000_000,
}
RUN_ENDS_S = 120.0


def flags(settings: Mapping[str, object]) -> list[str]:
    return [word for name, value in {**SMALL, **settings}.items() for word in (f"--{name}", *str(value).split())]


def trained(stage: Stage, env: str, settings: Mapping[str, object]) -> Learner:
    """`millrace train`, with worker processes of its own."""
    command = [sys.executable, "-m", "millrace", "train", f"{ENVS}:{env}", "--run-dir", str(stage.runs), *flags(settings)]
    learner = Learner(command, stage.tmp_path / "train.log", stage.runs)
    stage.started.append(learner)
    return learner


def served(stage: Stage, env: str, settings: Mapping[str, object], *worker_flags: str) -> tuple[Learner, Running]:
    """`millrace learner`, and one supervisor with a worker."""
    address = f"tcp://127.0.0.1:{free_port()}"
    learner = stage.learner(address, {**SMALL, **settings}, env=f"{ENVS}:{env}")
    return learner, stage.worker(address, "w0", *worker_flags)


class IdleCores(Callback):
    """Makes a learner believe that its machine's cores are idle. The tests that run at the same time may keep them busy."""

    def __init__(self) -> None:
        ticks = itertools.count(1)

        def core_times() -> CoreTimes:
            now = next(ticks)
            return CoreTimes(idle=now, total=now)

        mock.patch.object(worker_pool, "core_times", core_times).start()


def test_if_steps_wait_a_worker_for_each_lane_is_suggested(stage: Stage) -> None:
    lanes = 2 * usable_cores()
    settings = {"env-kwargs": "step_s 0.1 k 30", "envs": lanes, "lanes": lanes, "callbacks": f"{__name__}:IdleCores"}
    learner = trained(stage, "Slow-v0", settings)
    learner.hears(
        rf"env steps wait for \d+% of their time: --workers {lanes}, one for each lane, would be faster", RUN_ENDS_S
    )


def never_given_up(learner: Learner) -> None:
    assert "silent" not in learner.said()
    assert learner.ledger()["lost"] == 0


ELSEWHERE = pytest.param("elsewhere", marks=pytest.mark.soak)


@pytest.mark.parametrize("kind", ["local", ELSEWHERE])
def test_calls_that_take_longer_than_the_worker_timeout(stage: Stage, kind: str) -> None:
    slow = {"env-kwargs": "make_s 2.0 reset_s 1.5 step_s 1.5 k 2"}
    learner = trained(stage, "Slow-v0", slow) if kind == "local" else served(stage, "Slow-v0", slow)[0]
    learner.trains(2)
    never_given_up(learner)


def test_a_call_that_holds_the_interpreter_lock_for_longer_than_the_worker_timeout(stage: Stage) -> None:
    """No thread of the worker can run meanwhile: only its supervisor can speak."""
    learner, _ = served(stage, "Slow-v0", {"env-kwargs": "make_s 1.2 step_s 1.2 holds_lock true"})
    learner.trains(2)
    never_given_up(learner)


@pytest.mark.parametrize("kind", ["local", ELSEWHERE])
def test_a_step_that_hangs_ends_by_the_step_timeout_and_is_named(stage: Stage, kind: str, tmp_path: Path) -> None:
    once = tmp_path / "hung"
    settings = {"env-kwargs": f"once {once} after 20", "step-timeout-s": 3}
    env = "tests.support.envs.toy:Hangs-v0"
    if kind == "local":
        command = [sys.executable, "-m", "millrace", "train", env, "--run-dir", str(stage.runs), *flags(settings)]
        learner = Learner(command, stage.tmp_path / "train.log", stage.runs)
        stage.started.append(learner)
    else:
        address = f"tcp://127.0.0.1:{free_port()}"
        learner = stage.learner(address, {**SMALL, **settings}, env=env)
        stage.worker(address, "w0")
    learner.until(lambda row: row["ledger/lost"] > 0, START_S, "an update with tickets dealt again")
    within(f"a step that hangs, {kind}", time.time() - once.stat().st_mtime, 3 + 1 + 1.5)  # + the restart of its worker
    learner.hears(
        r"worker w\d.*step of its environment took longer than 3 s \(--step-timeout-s\), at .*toy.py:\d+, in fault"
    )
    learner.trains(2)


@pytest.mark.parametrize("call", ["make_s", "reset_s"])
def test_a_construction_and_a_reset_have_a_timeout_of_their_own(stage: Stage, call: str) -> None:
    learner = trained(stage, "Slow-v0", {"env-kwargs": f"{call} 60.0", "start-timeout-s": 2, "max-env-failures": 0})
    assert learner.ends(RUN_ENDS_S) == 1
    assert re.search(r"took longer than 2 s \(--start-timeout-s\), at .*slow_envs.py:\d+", learner.said()), learner.said()


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("sys.exit-0", "SystemExit: 0"),
        pytest.param("os.exit-2", "its process ended with exit code 2 in a step of its environment", marks=pytest.mark.soak),
        pytest.param("os.exit-0", "its process ended with exit code 0 in a step of its environment", marks=pytest.mark.soak),
        ("os.exit-69", "its process ended with exit code 69 in a step of its environment"),
        pytest.param("segfault", "its process was killed by SIGSEGV in a step of its environment", marks=pytest.mark.soak),
        pytest.param("kill", "its process was killed by SIGKILL in a step of its environment", marks=pytest.mark.soak),
    ],
)
def test_an_environment_that_ends_its_process_is_a_failure_like_any_other(stage: Stage, how: str, says: str) -> None:
    """Every worker process ends at its 130th step. The run ends well if so many failures are allowed."""
    settings = {"env-kwargs": f"how {how} after 130", "steps": 400, "rollout-steps": 50, "batch-size": 100, "workers": 1}
    learner = trained(stage, "Ends-v0", {**settings, "max-env-failures": 20})
    assert learner.ends(RUN_ENDS_S) == 0, learner.said()
    assert len(re.findall(re.escape(says), learner.said())) >= 3, learner.said()
    assert learner.summary()["env_steps"] >= 300


@pytest.mark.parametrize("kind", ["local", "elsewhere"])
def test_too_many_ends_of_the_process_end_the_run_and_name_the_code(stage: Stage, kind: str) -> None:
    settings = {"env-kwargs": "how os.exit-0 after 100", "rollout-steps": 50, "batch-size": 100, "max-env-failures": 1}
    supervisor = None
    if kind == "local":
        learner = trained(stage, "Ends-v0", {**settings, "workers": 1})
    else:
        learner, supervisor = served(stage, "Ends-v0", settings)
    assert learner.ends(RUN_ENDS_S) == 1
    line = learner.said().splitlines()[-1]
    assert "ended with exit code 0 in a step of its environment; failure 2 within an hour; max_env_failures allows 1" in line
    if supervisor is not None:
        supervisor.signal(15)
        supervisor.ends(15)


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["local", "elsewhere"])
def test_what_an_environment_leaves_behind_is_gone_after_the_run(stage: Stage, kind: str, tmp_path: Path) -> None:
    """A child process, a thread that is not a daemon, ignored signals, and a `close` that does not return."""
    pid_file = tmp_path / "pids"
    settings = {"env-kwargs": f"pid_file {pid_file}", "steps": 200, "workers": 1}
    if kind == "local":
        learner = trained(stage, "LeavesThings-v0", settings)
    else:
        del settings["workers"]
        learner, supervisor = served(stage, "LeavesThings-v0", settings)
    learner.until(lambda row: row["time/total_timesteps"] > 100, START_S, "half of the run")
    pids = [int(pid) for pid in pid_file.read_text().split()]
    assert learner.ends(RUN_ENDS_S) == 0, learner.said()
    ended_s = time.monotonic()
    wait_for(lambda: not any(map(psutil.pid_exists, pids)), 10, f"the end of all of {pids}")
    within(f"everything that an environment started is gone, {kind}", time.monotonic() - ended_s, 10)
    if kind == "elsewhere":
        assert supervisor.ends(10) == 0, supervisor.said()


@pytest.mark.soak
def test_a_worker_that_is_told_to_leave_during_a_long_step_is_gone_in_ten_seconds(stage: Stage) -> None:
    learner, supervisor = served(stage, "Slow-v0", {"env-kwargs": "step_s 600.0"})
    learner.hears("worker w0 .* joined", START_S)
    (worker,) = wait_for(lambda: workers_of(supervisor.pid), 5, "the worker")
    time.sleep(1)
    supervisor.signal(15)
    began_s = time.monotonic()
    supervisor.ends(12)
    within("SIGTERM to a supervisor whose worker is in a long step", time.monotonic() - began_s, 10)
    assert not worker.is_running()


def test_a_worker_that_is_stopped_is_given_up_although_its_supervisor_lives(stage: Stage) -> None:
    learner, supervisor = served(stage, "Slow-v0", {"env-kwargs": "step_s 0.2", "rollout-steps": 50, "batch-size": 100})
    learner.hears("worker w0 .* joined", START_S)
    (worker,) = workers_of(supervisor.pid)
    time.sleep(1)
    worker.suspend()
    began_s = time.monotonic()
    learner.hears("worker w0 silent for 1 s", 20)
    within("worker stopped, its supervisor alive", time.monotonic() - began_s, 1 + 1)
    worker.resume()


def test_status_names_the_lane_and_the_call_of_a_worker_that_hangs_and_for_how_long(stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    learner = stage.learner(address, {**SMALL, "env-kwargs": "reset_s 600.0"}, env=f"{ENVS}:Slow-v0")
    stage.worker(address, "w0")
    learner.hears("worker w0 .* joined", START_S)
    time.sleep(3)

    def status(*flags: str) -> str:
        command = [sys.executable, "-m", "millrace", "status", address, *flags]
        done = preloaded.run(command, cwd=ROOT, timeout=60)
        assert done.returncode == 0, done.stderr
        return done.stdout

    told = json.loads(status("--json"))
    (worker,) = told["workers"]
    assert worker["doing"] == "resetting"
    assert 2.0 < worker["doing_s"] < 60.0
    assert re.fullmatch(
        r"waiting \d+ s for lanes 0, 1 \(worker w0 on .*: in reset for \d+ s\)(; so far.*)?", told["progress"]["waiting"]
    )
    table = status().splitlines()
    assert re.match(r"The learner has been waiting \d+ s for lanes 0, 1 \(worker w0 on .*: in reset for \d+ s\)", table[1])
    assert re.search(r"in reset for \d+ s", table[4])


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_the_whole_case_with_default_timeouts(stage: Stage) -> None:
    """A constructor of 40 s, resets of 15 s, steps of 8 s, one lane per worker: two updates."""
    settings = {"env-kwargs": "make_s 40.0 reset_s 15.0 step_s 8.0", "worker-timeout-s": 5}
    learner = trained(stage, "Slow-v0", settings)
    began_s = time.monotonic()
    learner.trains(2, 300)
    bound_s = 2 * 40 + 15 + 4 * 8 + 60  # the first construction is that of the description
    within("two updates of an environment whose calls take 40, 15 and 8 s", time.monotonic() - began_s, bound_s)
    never_given_up(learner)
