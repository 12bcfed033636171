"""How a supervisor sees the end of a worker's process."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from millrace.flags.parse import parse_flags
from millrace.protocol.call_timeouts import CallTimeouts, Doing
from millrace.protocol.keys.keys import Key, Token
from millrace.protocol.keys.worker_token import TOKEN_VARIABLE, read_token
from millrace.workers import activity, program
from millrace.workers.activity import ENV_CALLS, SINCE_S, STEPPING, Activity, ActivityReader
from millrace.workers.flags import WorkerFlags
from millrace.workers.supervise import worker_process
from millrace.workers.supervise.how_it_ended import Ending
from millrace.workers.supervise.worker_process import MOST_LAST_LINES, WorkerCommand, WorkerProcess

WITHIN_S = 60.0


def ending_of(script: str, monkeypatch: pytest.MonkeyPatch) -> Ending | None:
    """How a worker ends in whose place a shell runs this script."""

    def popen(command: list[str], **how: Any) -> subprocess.Popen[bytes]:
        return subprocess.Popen(["sh", "-c", script], **how)

    monkeypatch.setattr(worker_process, "popen", popen)
    worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0"))
    worker.wait(WITHIN_S)
    return worker.ended()


@contextmanager
def children_reaped_by_the_system() -> Iterator[None]:
    """As in a program that ignores SIGCHLD, or was started by one."""
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_the_signal_that_ended_a_process_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    ending = ending_of("kill -9 $$", monkeypatch)
    assert ending == Ending(-9, "was killed by SIGKILL while it started", last_lines="")


def test_a_signal_without_a_name_is_numbered(monkeypatch: pytest.MonkeyPatch) -> None:
    ending = ending_of(f"kill -{signal.SIGRTMIN + 1} $$", monkeypatch)
    assert ending == Ending(
        -signal.SIGRTMIN - 1, f"was killed by signal {signal.SIGRTMIN + 1} while it started", last_lines=""
    )


def test_a_process_that_was_reaped_already_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    with children_reaped_by_the_system():
        ending = ending_of("exit 3", monkeypatch)
    assert ending == Ending(0, "ended while it started; its exit code is not known", last_lines="")


def test_the_wait_for_a_process_that_no_signal_ends_has_a_deadline(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(
        worker_process, "popen", lambda command, **how: subprocess.Popen(["sh", "-c", "exec sleep 60"], **how)
    )
    worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0"))
    with monkeypatch.context() as during:
        during.setattr(worker_process, "KILLED_WITHIN_S", 0.1)
        during.setattr(worker, "_kill_session", lambda: None)
        worker.wait(0.0)
    assert worker.ended() is None
    assert [record.message for record in caplog.records] == [
        f"worker w0 (process {worker.pid}) was killed and has not ended; it is left behind"
    ]
    worker.wait(0.0)  # with a signal that ends it
    assert worker.ended() == Ending(-9, "was killed by SIGKILL while it started", last_lines="")


def test_a_worker_is_spoken_for_until_its_end_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has ended, and its simulator takes long to be gone: the learner must not take it for silent before it hears why."""
    monkeypatch.setattr(worker_process, "popen", lambda command, **how: subprocess.Popen(["sh", "-c", "exit 3"], **how))
    worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0"))
    with monkeypatch.context() as during:
        during.setattr(worker, "_kill_session", lambda: None)
        during.setattr(worker_process, "live_members", lambda session: [worker.pid])
        os.waitid(os.P_PID, worker.pid, os.WEXITED | os.WNOWAIT)
        assert worker.ended() is None
        assert worker.activity(time.monotonic()) is not None
    assert worker.ended() == Ending(3, "ended with exit code 3 while it started", last_lines="")
    assert worker.activity(time.monotonic()) is None


def test_the_end_says_whether_calls_of_the_environment_had_returned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_process, "popen", lambda command, **how: subprocess.Popen(["sh", "-c", "exit 3"], **how))
    worked = []
    for calls in (0, 1):
        worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0"))
        os.pwrite(worker._page.fd, calls.to_bytes(8, sys.byteorder), 8 * ENV_CALLS)
        worker.wait(10.0)
        ending = worker.ended()
        assert ending is not None
        worked.append(ending.worked)
    assert worked == [False, True]


def test_what_a_worker_wrote_last_is_told_if_it_ended_before_it_had_joined(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    script = "for i in $(seq 100); do echo line $i; done; exit 3"
    monkeypatch.setattr(worker_process, "popen", lambda command, **how: subprocess.Popen(["sh", "-c", script], **how))
    worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0", tmp_path / "w0.log"))
    worker.wait(WITHIN_S)
    last_lines = "\n".join(f"line {n}" for n in range(101 - MOST_LAST_LINES, 101))
    assert worker.ended() == Ending(3, "ended with exit code 3 while it started (line 100)", last_lines=last_lines)


@pytest.mark.parametrize(("code", "last_lines"), [(2, "no such key"), (0, None)])
def test_one_that_leaves_on_purpose_before_it_has_joined_says_why_if_it_failed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, code: int, last_lines: str | None
) -> None:
    script = f"echo no such key; exit {code}"
    monkeypatch.setattr(worker_process, "popen", lambda command, **how: subprocess.Popen(["sh", "-c", script], **how))
    worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0", tmp_path / "w0.log"))
    os.pwrite(worker._page.fd, (code + 1).to_bytes(8, sys.byteorder), 8 * activity.LEAVES)
    worker.wait(WITHIN_S)
    ending = worker.ended()
    assert ending is not None
    assert (ending.code, ending.on_purpose, ending.last_lines) == (code, True, last_lines)


@pytest.mark.parametrize("given", [None, Token(Key.new().public, Key.new())], ids=["no token", "a token"])
def test_a_worker_gets_the_token_that_its_supervisor_gives_it_and_no_other(
    monkeypatch: pytest.MonkeyPatch, given: Token | None
) -> None:
    """Through a pipe, because every process of the user can read the environment variables of the others."""
    monkeypatch.setenv(TOKEN_VARIABLE, "of another learner")
    got: list[Token | None] = []

    def popen(command: list[str], **how: Any) -> subprocess.Popen[bytes]:
        words = [*command, *how["env"].values()]
        assert TOKEN_VARIABLE not in how["env"]
        assert given is None or not any(given.to_text() in word for word in words)
        monkeypatch.delenv(TOKEN_VARIABLE)
        flags = parse_flags(WorkerFlags, command[4:], "worker")
        got.append(read_token(flags.token))
        assert given is None or int(Path(flags.token).name) in how["pass_fds"]
        return subprocess.Popen(["true"], **how)

    monkeypatch.setattr(worker_process, "popen", popen)
    WorkerProcess(WorkerCommand("tcp://127.0.0.1:1", "w0", token=given)).wait(WITHIN_S)
    assert got == [given]


@pytest.mark.parametrize(
    ("doing", "of_policy"),
    [("acting", True), ("preparing", True), ("stepping", False), ("closing", False), ("waiting", False)],
)
def test_the_end_says_whether_the_policy_is_to_blame(
    monkeypatch: pytest.MonkeyPatch, doing: Doing, *, of_policy: bool
) -> None:
    monkeypatch.setattr(worker_process, "popen", lambda command, **how: subprocess.Popen(["sh", "-c", "exit 3"], **how))
    worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0"))
    os.pwrite(worker._page.fd, activity.DOINGS.index(doing).to_bytes(8, sys.byteorder), 8 * activity.DOING)
    worker.wait(10.0)
    ending = worker.ended()
    assert ending is not None
    assert ending.of_policy == of_policy
    assert ending.failed == (doing not in ("closing", "waiting"))


def test_a_call_is_ended_by_the_timeout_that_the_run_of_its_worker_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page is all that the supervisor knows of the run."""
    monkeypatch.setattr(
        worker_process, "popen", lambda command, **how: subprocess.Popen(["sh", "-c", "exec sleep 60"], **how)
    )
    monkeypatch.setattr(worker_process, "WRITE_STACKS_S", 0.0)
    for module in (worker_process, activity):  # this process writes to the page as the worker would
        monkeypatch.setattr(module, "STACK_SIGNAL", None)
    worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0"))
    try:
        page = Activity(os.dup(worker._page.fd))
        page.begin(STEPPING)
        began_s = page.seconds[SINCE_S]
        for limit_s, after_s, ends in ((0.0, 1e6, False), (30.0, 29.0, False), (30.0, 31.0, True)):
            page.limit(CallTimeouts(1.0, limit_s))
            for _ in range(2):
                worker.end_if_hung(began_s + after_s)
            assert (worker._because != "") == ends
    finally:
        worker.wait(0.0 if not worker._because else WITHIN_S)
    ending = worker.ended()
    assert ending is not None
    assert ending.reason == "was ended: a step of its environment took longer than 30 s (--step-timeout-s)"
    assert ending.failed


def test_a_process_that_cannot_be_started_leaves_no_descriptor_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    def popen(command: list[str], **how: Any) -> subprocess.Popen[bytes]:
        raise OSError("no memory")

    monkeypatch.setattr(worker_process, "popen", popen)
    page = ActivityReader()
    monkeypatch.setattr(worker_process, "ActivityReader", lambda: page)
    with pytest.raises(OSError, match="no memory"):
        WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0"))
    assert page.fd == -1


@pytest.mark.parametrize("learner_lives", [True, False])
def test_a_worker_whose_supervisor_was_killed_removes_the_socket_of_a_dead_learner_only(
    monkeypatch: pytest.MonkeyPatch, *, learner_lives: bool
) -> None:
    monkeypatch.setattr(program, "CLOSED_WITHIN_S", 0.0)
    with tempfile.TemporaryDirectory(prefix="millrace-") as folder, socket.socket(socket.AF_UNIX) as learner:
        path = Path(folder) / "learner"
        learner.bind(str(path))
        if learner_lives:
            learner.listen()
        program._remove_socket_of_killed_parent(f"ipc://{path}")
        assert (path.exists(), Path(folder).exists()) == (learner_lives, learner_lives)


def test_the_socket_of_a_learner_that_is_still_closing_is_removed_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(prefix="millrace-") as folder, socket.socket(socket.AF_UNIX) as learner:
        path = Path(folder) / "learner"
        learner.bind(str(path))
        learner.listen()
        monkeypatch.setattr(time, "sleep", lambda seconds: learner.close())
        program._remove_socket_of_killed_parent(f"ipc://{path}")
        assert not Path(folder).exists()
