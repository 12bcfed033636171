"""The slots of a machine: the lowest number that is free, and never one that another process holds."""

from __future__ import annotations

import fcntl
import os
import pwd
import re
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Barrier

import pytest

from millrace.protocol.errors import UsageError
from millrace.workers import machine_slots as module
from millrace.workers.machine_slots import (
    FILE_VARIABLE,
    LIMIT_VARIABLE,
    NoSlot,
    Slots,
    free_all,
    open_slots,
    share_slots,
    slots,
)


@pytest.fixture
def own_file() -> Path:
    """A file of the test's own."""
    return Path(os.environ[FILE_VARIABLE])


@contextmanager
def other_process(code: str, *fds: int) -> Iterator[subprocess.Popen[str]]:
    """A process that runs this code and then waits, with these descriptors; it has printed a line when this returns."""
    program = f"import sys, time; from millrace.workers.machine_slots import *; {code}; print(flush=True); time.sleep(100)"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, pass_fds=fds) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            yield process
        finally:
            process.kill()


def test_a_copy_gets_the_lowest_number_that_is_free() -> None:
    first, second = Slots(), Slots()
    assert [first.take(), first.take(), second.take(), first.take()] == [0, 1, 2, 3]
    first.give_back(1)
    assert [second.take(), second.take()] == [1, 4]


def test_the_kernel_frees_the_slots_of_a_killed_process() -> None:
    with other_process("slots().take(); slots().take()") as process:
        own = Slots()
        assert own.take() == 2
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert [own.take(), own.take(), own.take()] == [0, 1, 3]


def test_a_supervisor_holds_the_slots_of_a_killed_worker_until_it_frees_them() -> None:
    fd = open_slots()
    with other_process(f"Slots({fd}).take()", fd) as worker:
        worker.send_signal(signal.SIGKILL)
        worker.wait()
    own = Slots()
    assert own.take() == 1
    free_all(fd)
    assert own.take() == 0


def test_a_supervisor_frees_slots_that_a_fork_elsewhere_still_holds_open() -> None:
    fd, own = open_slots(), Slots()
    Slots(fd).take()
    with other_process("pass", fd):
        free_all(fd)
        assert own.take() == 0


def test_threads_never_share_a_slot() -> None:
    own = Slots()
    with ThreadPoolExecutor(8) as threads:
        assert sorted(threads.map(lambda _: own.take(), range(400))) == list(range(400))


def test_threads_that_ask_at_the_same_time_get_the_same_slots(monkeypatch: pytest.MonkeyPatch) -> None:
    both_open = Barrier(2, timeout=10.0)

    def opened() -> int:
        both_open.wait()
        return open_slots()

    monkeypatch.setattr(module, "open_slots", opened)
    with ThreadPoolExecutor(2) as threads:
        first, second = threads.map(lambda _: slots(), range(2))
    assert first is second
    first.give_back(first.take())


def test_a_process_and_its_fork_never_share_a_slot() -> None:
    ours, theirs = socket.socketpair()
    slots()  # opens the file, which the fork shares
    with ours, theirs:
        if (pid := os.fork()) == 0:
            theirs.send(bytes([slots().take()]))
            theirs.recv(1)
            os._exit(0)
        try:
            held = slots().take()
            assert ours.recv(1)[0] != held
            slots().give_back(held)
        finally:
            ours.send(b" ")
            os.waitpid(pid, 0)


def test_every_user_may_use_a_file_that_is_shared_on_purpose_whatever_the_umask(own_file: Path) -> None:
    before = os.umask(0o077)
    try:
        Slots()
    finally:
        os.umask(before)
    assert stat.S_IMODE(own_file.stat().st_mode) == 0o666


@pytest.fixture
def file_of_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Where users who share no file have theirs: a path with a place for the number of the user."""
    monkeypatch.delenv(FILE_VARIABLE)
    monkeypatch.setattr(module, "FILE", str(tmp_path / "slots-{user}"))
    return module.FILE


def test_a_user_who_shares_no_file_has_one_that_no_other_user_can_open(file_of_user: str) -> None:
    first, second = Slots(), Slots()
    assert (first.take(), second.take()) == (0, 1)
    assert stat.S_IMODE(Path(file_of_user.format(user=os.geteuid())).stat().st_mode) == 0o600


def test_a_file_that_another_user_put_in_the_place_of_ones_own_is_refused_and_its_owner_named(
    file_of_user: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stranger = pwd.getpwuid(os.geteuid()).pw_name
    Path(file_of_user.format(user=4_000_000_000)).touch()
    monkeypatch.setattr(os, "geteuid", lambda: 4_000_000_000)
    expected = rf"slots-4000000000: a file of user {stranger}; .* belongs to user 4000000000; set {FILE_VARIABLE} to "
    with pytest.raises(UsageError, match=expected):
        Slots()


@pytest.fixture
def all_locked(own_file: Path) -> Iterator[str]:
    """Somebody has locked the whole file. What a line says of the file."""
    fd = open_slots()
    module._lock(fd, fcntl.F_WRLCK, 0, 0)
    yield f"{own_file}, a file of user {pwd.getpwuid(os.geteuid()).pw_name}"
    os.close(fd)


def test_a_search_for_a_slot_ends_if_somebody_has_locked_the_whole_file_and_names_the_file_and_its_owner(
    all_locked: str,
) -> None:
    with pytest.raises(UsageError, match=f"has locked all of {re.escape(all_locked)}; .* MILLRACE_SLOTS") as error:
        Slots().take()
    assert not isinstance(error.value, NoSlot), "there is no limit, so there is no room to wait for"


def test_who_waits_for_room_is_told_the_file_and_its_owner(all_locked: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WAIT_S", 0.0)
    with pytest.raises(NoSlot, match=f"hold all 3 of {LIMIT_VARIABLE} [(]{re.escape(all_locked)}[)]$"):
        Slots(most=3).take()


def test_the_file_stays_empty_and_looks_used_so_that_nothing_that_cleans_tmp_deletes_it(own_file: Path) -> None:
    own = Slots()
    os.utime(own_file, (0, 0))
    own.take()
    used = own_file.stat()
    assert (used.st_mtime > 0, used.st_size) == (True, 0)
    own.take()
    assert own_file.stat().st_mtime_ns == used.st_mtime_ns, "not at every look"


@pytest.mark.parametrize("found", ["link", "fifo", "folder", "no folder"])
def test_what_is_no_file_of_slots_is_refused_in_one_line(
    found: str, own_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    match found:
        case "link":
            (tmp_path / "precious").touch()
            own_file.symlink_to(tmp_path / "precious")
        case "fifo":
            os.mkfifo(own_file)
        case "folder":
            own_file.mkdir()
        case "no folder":
            monkeypatch.setenv(FILE_VARIABLE, str(tmp_path / "none" / "slots"))
    with pytest.raises(UsageError, match=r"slots: .* who shares it may write; set MILLRACE_SLOTS to another path"):
        Slots()


def test_without_open_file_locks_processes_still_share_no_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(fcntl, "F_OFD_SETLK")
    own = Slots()
    assert own.take() == 0
    with other_process("import fcntl; del fcntl.F_OFD_SETLK; slots().take(); slots().take()"):
        assert own.take() == 3
    own.give_back(0)
    assert [own.take(), own.take()] == [0, 1]


# ---------------------------------------------------------------------------------------------- a limit of copies


def test_with_a_limit_a_copy_waits_until_a_slot_is_free(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    licensed, other = Slots(most=2), Slots()
    assert (licensed.take(), other.take()) == (0, 1)
    monkeypatch.setattr(time, "sleep", lambda seconds: other.give_back(1))  # while it waits
    assert licensed.take() == 1
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith("no slot is free on ")
    assert caplog.messages[0].endswith("; waiting for one")
    assert "other env copies hold all 2 of MILLRACE_COPIES_PER_MACHINE (" in caplog.messages[0]


def test_a_copy_that_waited_long_enough_gives_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WAIT_S", 0.0)
    licensed = Slots(most=1)
    licensed.take()
    with pytest.raises(NoSlot, match=r"other env copies hold all 1 of MILLRACE_COPIES_PER_MACHINE \("):
        licensed.take()


def test_the_variable_is_the_limit_of_every_process_and_what_is_no_number_is_refused_before_a_worker_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_of_processes", {})
    monkeypatch.setenv(LIMIT_VARIABLE, "3")
    assert slots().most == 3
    share_slots(fd := open_slots())
    assert (slots().fd, slots().most) == (fd, 3)
    monkeypatch.setenv(LIMIT_VARIABLE, "")
    os.close(open_slots())
    for wrong in ("-1", "four", "65537", "9" * 5000, "²"):
        monkeypatch.setenv(LIMIT_VARIABLE, wrong)
        with pytest.raises(UsageError, match=f"^{LIMIT_VARIABLE}: expected a whole number up to 65,536, .*'{wrong:.58}"):
            open_slots()


def test_there_is_room_if_so_many_slots_are_free_and_asking_takes_none() -> None:
    licensed, other = Slots(most=3), Slots()
    other.take()
    assert [licensed.have_room(copies) for copies in (1, 2, 3)] == [True, True, False]
    assert other.take() == 1
