"""When a worker's session is gone, and who holds the slots of env copies until then."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from millrace.workers.machine_slots import Slots
from millrace.workers.supervise import worker_process
from millrace.workers.supervise.process_group import kill, live_members, process_stat, use_of_sessions
from millrace.workers.supervise.worker_process import WorkerCommand, WorkerProcess

WITHIN_S = 60.0
SIMULATOR = "simulator = subprocess.Popen(['sleep', '1000'])"
RANK = "simulator = subprocess.Popen(['sleep', '1000'], process_group=0)"  # as mpirun starts the ranks of a program


@contextmanager
def session(program: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process that leads a session and runs this program, and the first line that it prints."""
    command = [sys.executable, "-c", f"import os, subprocess, sys, threading, time\n{program}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline()
        finally:
            if process.returncode is None:
                kill(live_members(process.pid))


def ended_but_not_reaped(process: subprocess.Popen[str]) -> None:
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)


def wait_until(is_so: Callable[[], Any]) -> None:
    deadline_s = time.monotonic() + WITHIN_S
    while not is_so():
        assert time.monotonic() < deadline_s
        os.sched_yield()


SPINS = "exec('while True: pass')"
IN_A_CHILD = f"subprocess.Popen([sys.executable, '-c', {SPINS!r}])"


@pytest.mark.parametrize(
    "computing", [IN_A_CHILD, f"threading.Thread(target=lambda: {SPINS}).start()"], ids=["in a child", "in a thread"]
)
def test_a_session_computes_even_if_its_leader_sleeps(computing: str) -> None:
    with session(f"{computing}; print(flush=True); time.sleep(1000)") as (process, _):
        wait_until(lambda: process_stat(process.pid)[0] == "S" and use_of_sessions({process.pid})[process.pid].computes)


def test_a_session_that_sleeps_does_not_compute_but_keeps_its_memory() -> None:
    with session("print(flush=True); time.sleep(1000)") as (process, _):
        wait_until(lambda: process_stat(process.pid)[0] == "S")
        computes, resident = use_of_sessions({process.pid})[process.pid]
        assert not computes
        assert resident > 1 << 20


def test_a_session_that_has_ended_uses_nothing() -> None:
    with session("print(flush=True)") as (process, _):
        process.wait(WITHIN_S)
        assert use_of_sessions({process.pid}) == {}


def test_a_zombie_that_nobody_reaps_is_gone() -> None:
    with session("print(flush=True)") as (process, _):
        ended_but_not_reaped(process)
        assert process_stat(process.pid)[0] == "Z"
        assert live_members(process.pid) == []


def test_a_process_whose_first_thread_has_ended_is_not_gone() -> None:
    program = "import ctypes; threading.Thread(target=time.sleep, args=(1000,)).start(); print(flush=True)"
    with session(f"{program}; ctypes.CDLL(None).pthread_exit(None)") as (process, _):
        wait_until(lambda: process_stat(process.pid)[0] == "Z")
        assert live_members(process.pid) == [process.pid]


@pytest.mark.parametrize("start", [SIMULATOR, RANK], ids=["of its group", "of another group"])
def test_what_a_dead_process_started_is_not_gone(start: str) -> None:
    with session(f"{start}; print(simulator.pid, flush=True); os._exit(0)") as (process, simulator):
        ended_but_not_reaped(process)
        assert live_members(process.pid) == [int(simulator)]


@pytest.mark.parametrize("gives_up", [False, True])
def test_the_slots_of_a_killed_worker_stay_taken_until_its_simulator_is_gone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, *, gives_up: bool
) -> None:
    imports = "import os, subprocess, sys; from millrace.workers.machine_slots import Slots"
    program = f"{imports}; Slots(int(sys.argv[1])).take(); {SIMULATOR}"

    def popen(command: list[str], **how: Any) -> subprocess.Popen[bytes]:
        taker = [sys.executable, "-c", f"{program}; print(simulator.pid, flush=True); os.kill(os.getpid(), 9)"]
        return subprocess.Popen([*taker, command[command.index("--slots") + 1]], **how | {"stdout": subprocess.PIPE})

    monkeypatch.setattr(worker_process, "popen", popen)
    monkeypatch.setattr(worker_process, "KILLED_WITHIN_S", 0.0 if gives_up else WITHIN_S)
    worker, others = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0")), Slots()
    monkeypatch.setattr(worker, "_kill_session", lambda: None)  # the system takes its time
    with worker._process:
        assert worker._process.stdout is not None
        simulator = int(worker._process.stdout.readline())
        wait_until(lambda: not worker._runs())
        try:
            assert (worker.ended() is not None) == gives_up
            assert others.take() == 1
            others.give_back(1)
        finally:
            os.kill(simulator, signal.SIGKILL)
    wait_until(lambda: worker.ended() is not None)
    assert others.take() == (1 if gives_up else 0)
    said = [f"worker w0 has ended, but processes [{simulator}] of its environment have not, so its slots stay taken"]
    assert [record.message for record in caplog.records] == (said if gives_up else [])


def test_what_a_dead_worker_started_is_killed_also_in_a_process_group_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def popen(command: list[str], **how: Any) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", f"import subprocess; {RANK}"], **how)

    monkeypatch.setattr(worker_process, "popen", popen)
    monkeypatch.setattr(worker_process, "KILLED_WITHIN_S", 2 * WITHIN_S)  # it is not given up
    worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0"))
    try:
        wait_until(lambda: worker.ended() is not None)
    finally:
        kill(live_members(worker.pid))


@pytest.mark.parametrize("start", [SIMULATOR, RANK], ids=["of its group", "of another group"])
def test_a_worker_whose_supervisor_was_killed_ends_after_its_simulators(start: str) -> None:
    program = (
        "from millrace.workers import program; members = program.live_members; "
        "program.live_members = lambda leader: print(*(found := members(leader)), flush=True) or found"
    )
    with session(f"{program}; {start}; print(simulator.pid, flush=True); program._kill_own_session()") as (
        process,
        simulator,
    ):
        assert process.stdout is not None
        said = process.stdout.read()
        seen = [sorted(map(int, line.split())) for line in said.splitlines()]
        assert seen[0] == sorted([process.pid, int(simulator)])
        assert seen[-1] == [process.pid]
        assert process.wait() == -signal.SIGKILL
