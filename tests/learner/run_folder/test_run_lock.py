"""The lock of a run folder: one owner at a time, on one machine by the system, across machines by a file that changes."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from millrace.learner.run_folder.lease import WIDTH, LeaseWatch, Listens, Owner, Unreachable, Verdict, decoded
from millrace.learner.run_folder.living_owner import LearnerOfRun, learner_of_run, living_owner
from millrace.learner.run_folder.run_lock import LOCK_FILE, Claim, Pace, RunLock, SystemLock, claim
from millrace.protocol.errors import RunError, RunTakenOver, UsageError

ELSEWHERE = Owner(host="far", pid=77, boot_id="another kernel", token="theirs")
SOCKET = Listens("ipc:///tmp/here/learner", "ipc:///tmp/here/learner")
NEVER = Pace(rewrite_every=1e6, dead_after=30.0, look_every=1.0, confirm_after=1.0)
OWNS = """
import sys
from pathlib import Path
from millrace.learner.run_folder.run_lock import RunLock
with RunLock(Path(sys.argv[1])):
    print("taken", flush=True)
    sys.stdin.read()
"""


class Time:
    """A clock that `sleep` moves; what is to happen meanwhile happens then."""

    def __init__(self, meanwhile: Callable[[float], object] = lambda now: None) -> None:
        self.now = 1000.0
        self._meanwhile = meanwhile

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        self._meanwhile(self.now)

    def clock(self) -> float:
        return self.now


def lock(folder: Path, time: Time | None = None, pace: Pace = NEVER) -> RunLock:
    time = time or Time()
    return RunLock(folder, pace, time.clock, time.sleep)


def owner_of(folder: Path) -> Owner:
    found = decoded((folder / LOCK_FILE).read_bytes())
    assert found is not None
    return found


def held_elsewhere(folder: Path, count: int = 0) -> None:
    (folder / LOCK_FILE).write_bytes(
        Owner(host="far", pid=77, boot_id="another kernel", token="theirs", count=count).encoded()
    )


# ------------------------------------------------------------------------------------------- the judgement


def test_an_observer_judges_by_its_own_clock() -> None:
    for began in (0.0, 1e9):
        watch = LeaseWatch(b"1", began, 30.0)
        assert watch.judge(b"1", began + 29.9) is Verdict.UNKNOWN
        assert watch.judge(b"1", began + 30.0) is Verdict.DEAD
        assert watch.judge(b"2", began + 31.0) is Verdict.ALIVE
        assert watch.judge(b"", began + 1.0) is Verdict.ALIVE


@pytest.mark.parametrize(
    ("locked", "owners"),
    [
        (SystemLock.OURS, {"here": Claim.AT_ONCE, "far": Claim.AFTER_WAIT, "unknown": Claim.AFTER_WAIT}),
        (SystemLock.OTHERS, {"here": Claim.REFUSED, "far": Claim.AFTER_WAIT, "unknown": Claim.REFUSED}),
        (SystemLock.NOBODYS, {"here": Claim.AFTER_WAIT, "far": Claim.AFTER_WAIT, "unknown": Claim.AFTER_WAIT}),
    ],
)
def test_only_the_system_s_lock_of_this_machine_decides_at_once(locked: SystemLock, owners: dict[str, Claim]) -> None:
    """A file that this process has just made is its own, unless another process on this machine locked it first."""
    for boot_id, expected in owners.items():
        owner = None if boot_id == "unknown" else replace(ELSEWHERE, boot_id=boot_id)
        assert claim(locked, owner, "here", made=False) is expected
        assert claim(locked, owner, "here", made=True) is (Claim.REFUSED if expected is Claim.REFUSED else Claim.NEW)


def test_every_rewrite_replaces_the_whole() -> None:
    lengths = {
        len(Owner(host="h" * n, pid=n, boot_id="b" * 36, token="t" * 16, count=10**n).encoded()) for n in range(1, 15)
    }
    assert len(lengths) == 1
    assert decoded(ELSEWHERE.encoded()) == ELSEWHERE
    for damaged in (b"", b"{}", ELSEWHERE.encoded()[:40], b"\xff" * 512):
        assert decoded(damaged) is None


# ------------------------------------------------------------------------------------------- one machine


def test_a_second_one_is_refused_and_named_and_a_released_lock_leaves_nothing(tmp_path: Path) -> None:
    with lock(tmp_path):
        before = (tmp_path / LOCK_FILE).read_bytes()
        with pytest.raises(UsageError, match=rf"^run {tmp_path}: process {os.getpid()} on \S+ is training it; .*kill"):
            lock(tmp_path).__enter__()
        assert (tmp_path / LOCK_FILE).read_bytes() == before
    assert not (tmp_path / LOCK_FILE).exists()
    with lock(tmp_path):
        assert owner_of(tmp_path).pid == os.getpid()
    assert "run-lock" not in [thread.name for thread in threading.enumerate()]


@pytest.mark.process
def test_the_lock_of_a_process_that_was_killed_is_taken_over_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", OWNS, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parents[3],
    ) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == b"taken\n"
            with pytest.raises(UsageError, match=rf"process {other.pid} on \S+ is training it"):
                lock(tmp_path).__enter__()
        finally:
            other.send_signal(signal.SIGKILL)
    time = Time()
    with lock(tmp_path, time):
        assert owner_of(tmp_path).pid == os.getpid()
    assert time.now == 1000.0, "the kernel knows that it is dead: nothing to wait for"
    assert f"process {other.pid} on" in caplog.text
    assert "held its lock and is gone; this process takes over" in caplog.text


@pytest.mark.process
def test_a_lock_that_a_stranger_holds_is_not_said_to_be_that_of_a_process_that_is_gone(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", "pass"]) as other:
        other.wait()
    with lock(tmp_path):
        owner = owner_of(tmp_path)
    (tmp_path / LOCK_FILE).write_bytes(replace(owner, pid=other.pid).encoded())
    with (tmp_path / LOCK_FILE).open() as read_only:
        fcntl.flock(read_only, fcntl.LOCK_EX)
        expected = rf"process {other.pid} on \S+, .*, is gone, but another process has locked {tmp_path}/run.lock; "
        with pytest.raises(UsageError, match=expected):
            lock(tmp_path).__enter__()


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"run.lock not written: No such file or directory"):
        lock(tmp_path / "nowhere").__enter__()


# ------------------------------------------------------------------------------------------- several machines


def test_an_owner_elsewhere_that_lives_is_not_disturbed(tmp_path: Path) -> None:
    held_elsewhere(tmp_path)
    time = Time(lambda now: held_elsewhere(tmp_path, count=int(now // 3)))
    with pytest.raises(UsageError, match=rf"^run {tmp_path}: process 77 on far is training it; .*end that process"):
        lock(tmp_path, time).__enter__()
    assert time.now <= 1003.0
    assert owner_of(tmp_path).token == "theirs"


def test_an_owner_elsewhere_that_is_dead_is_replaced_after_the_whole_time(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    held_elsewhere(tmp_path)
    time = Time()
    with lock(tmp_path, time):
        assert time.now >= 1000.0 + NEVER.dead_after
        assert owner_of(tmp_path).pid == os.getpid()
    assert "its lock names process 77 on far; waiting up to 30 s" in caplog.text
    assert "process 77 on far held its lock and is gone" in caplog.text


@pytest.mark.parametrize("lives", [True, False])
def test_a_system_lock_that_another_machine_seems_to_hold_is_judged_by_the_lease(tmp_path: Path, lives: bool) -> None:
    """On some network file systems, the server keeps the lock of a machine that died."""
    held_elsewhere(tmp_path)
    time = Time(lambda now: held_elsewhere(tmp_path, count=int(now // 3)) if lives else None)
    with (tmp_path / LOCK_FILE).open() as far:
        fcntl.flock(far, fcntl.LOCK_EX)
        if lives:
            with pytest.raises(UsageError, match=rf"^run {tmp_path}: process 77 on far is training it"):
                lock(tmp_path, time).__enter__()
            assert owner_of(tmp_path).token == "theirs"
        else:
            with lock(tmp_path, time) as mine:
                assert time.now >= 1000.0 + NEVER.dead_after
                assert owner_of(tmp_path).pid == os.getpid()
                mine.confirm()
                with pytest.raises(UsageError, match=rf"process {os.getpid()} on \S+ is training it"):
                    lock(tmp_path).__enter__()
            assert not [*tmp_path.glob("*lock*")]


def test_of_two_that_replace_a_locked_file_at_the_same_time_one_is_refused(tmp_path: Path) -> None:
    held_elsewhere(tmp_path)
    third = Owner(host="third", pid=5, boot_id="a third kernel", token="third")
    time = Time(lambda now: (tmp_path / LOCK_FILE).write_bytes(third.encoded()) if now > 1030 else None)
    with (tmp_path / LOCK_FILE).open() as far:
        fcntl.flock(far, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="process 5 on third is training it"):
            lock(tmp_path, time).__enter__()
    assert owner_of(tmp_path) == third


def test_a_lock_that_is_released_while_one_waits_is_taken(tmp_path: Path) -> None:
    held_elsewhere(tmp_path)
    time = Time(lambda now: (tmp_path / LOCK_FILE).unlink(missing_ok=True) if now < 1002 else None)
    with lock(tmp_path, time):
        assert time.now < 1003.0
        assert owner_of(tmp_path).pid == os.getpid()


def test_of_two_that_take_over_at_the_same_time_one_is_refused(tmp_path: Path) -> None:
    held_elsewhere(tmp_path)
    third = Owner(host="third", pid=5, boot_id="a third kernel", token="third")
    time = Time(lambda now: (tmp_path / LOCK_FILE).write_bytes(third.encoded()) if now > 1030 else None)
    with pytest.raises(UsageError, match="process 5 on third is training it"):
        lock(tmp_path, time).__enter__()
    assert owner_of(tmp_path) == third


def test_a_file_system_without_locks_is_judged_like_another_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(file: int, operation: int) -> None:
        raise OSError(errno.ENOTSUP, "not supported")

    monkeypatch.setattr(fcntl, "flock", flock)
    first = lock(tmp_path)
    with first:
        time = Time(lambda now: first.confirm())
        with pytest.raises(UsageError, match=f"process {os.getpid()} on"):
            lock(tmp_path, time).__enter__()
        first.check()
    assert not (tmp_path / LOCK_FILE).exists()


def test_who_was_replaced_notices_and_writes_nothing_more(tmp_path: Path) -> None:
    mine = lock(tmp_path)
    with mine:
        mine.confirm()
        assert owner_of(tmp_path).count == 1
        held_elsewhere(tmp_path)
        theirs = (tmp_path / LOCK_FILE).read_bytes()
        mine.check()  # not known yet
        for _ in range(2):
            with pytest.raises(RunTakenOver, match=rf"^run {tmp_path}: process 77 on far took it over, .* 30 s"):
                mine.confirm()
        with pytest.raises(RunTakenOver):
            mine.check()
        assert mine.taken_over
    assert (tmp_path / LOCK_FILE).read_bytes() == theirs


@pytest.mark.parametrize("suspended_s", [29.0, 31.0])
def test_a_lock_that_is_gone_after_a_suspension_is_recreated_only_if_nobody_can_have_had_it(
    tmp_path: Path, suspended_s: float
) -> None:
    """Another process may have taken the run over, trained it and ended, which removes the file."""
    wall = Time()
    with RunLock(tmp_path, NEVER, wall_clock=wall.clock) as mine:
        for _ in range(3):
            wall.now += 29.0
            mine.confirm()
        (tmp_path / LOCK_FILE).unlink()
        wall.now += suspended_s
        if suspended_s < NEVER.dead_after:
            mine.confirm()
            assert owner_of(tmp_path).pid == os.getpid()
        else:
            with pytest.raises(RunTakenOver, match=rf"^run {tmp_path}: run.lock is gone, .* for 31 s; another process may"):
                mine.confirm()
            assert mine.taken_over
            assert not (tmp_path / LOCK_FILE).exists()


def test_a_folder_that_was_gone_for_long_and_is_made_again_is_still_ours(tmp_path: Path) -> None:
    wall = Time()
    folder = tmp_path / "run"
    folder.mkdir()
    with RunLock(folder, NEVER, wall_clock=wall.clock) as mine:
        folder.rename(tmp_path / "renamed")
        for _ in range(20):  # the thread looks every 3 s
            wall.now += 3.0
            mine.confirm()
        folder.mkdir()
        mine.confirm()
        assert owner_of(folder).pid == os.getpid()


def test_the_file_is_rewritten_again_and_again_and_made_again(tmp_path: Path) -> None:
    rewritten = threading.Event()

    class Noticed(RunLock):
        def _write(self) -> None:
            super()._write()
            if self._owner.count >= 3:
                rewritten.set()

    with Noticed(tmp_path, Pace(rewrite_every=0.001)) as held:
        assert rewritten.wait(10)
        (tmp_path / LOCK_FILE).unlink()
        held.confirm()
        assert owner_of(tmp_path).pid == os.getpid()
        with pytest.raises(UsageError, match="is training it"):
            lock(tmp_path).__enter__()
    assert not (tmp_path / LOCK_FILE).exists()


# ------------------------------------------------------------------------------------------- where its learner listens


def test_the_lock_says_where_the_learner_listens_and_keeps_saying_it(tmp_path: Path) -> None:
    with lock(tmp_path) as held:
        with pytest.raises(
            UsageError, match=rf"process {os.getpid()} on \S+ trains it and cannot be asked: it has not begun"
        ):
            learner_of_run(tmp_path)
        held.announce(SOCKET)
        assert learner_of_run(tmp_path) == LearnerOfRun(SOCKET.here, None, is_here=True)
        held.confirm()
        assert learner_of_run(tmp_path).address == SOCKET.here, "the next rewriting keeps it"
        assert len((tmp_path / LOCK_FILE).read_bytes()) == WIDTH
        for long in (
            SOCKET._replace(address="tcp://" + "h" * WIDTH + ":5555"),
            SOCKET._replace(keys="/" + "\N{LATIN SMALL LETTER E WITH ACUTE}" * (WIDTH // 2)),
        ):
            held.announce(long)
            assert len((tmp_path / LOCK_FILE).read_bytes()) == WIDTH
            assert owner_of(tmp_path).address == ""
        for why, line in (
            (Unreachable.INPROC, "cannot be asked: with --transport inproc it listens in its own process only"),
            (Unreachable.KEYS_OF_THE_RUN, "cannot be asked: .* of its local workers are not in any file; run it with"),
        ):
            held.announce(why)
            with pytest.raises(UsageError, match=line):
                learner_of_run(tmp_path)
            assert len((tmp_path / LOCK_FILE).read_bytes()) == WIDTH
        held.announce(SOCKET)
        assert learner_of_run(tmp_path).address == SOCKET.here, "it is open again"
        with (tmp_path / LOCK_FILE).open("ab") as file:
            file.write(b" ")
        with pytest.raises(UsageError, match=f"expected at most {WIDTH:,} bytes"):
            learner_of_run(tmp_path)
    with pytest.raises(UsageError, match="no process trains it now"):
        learner_of_run(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"rubbish", "names no process"),
        (
            replace(ELSEWHERE, address="ipc:///tmp/x").encoded(),
            "process 77 on far trains it, and only that machine can reach",
        ),
        (replace(ELSEWHERE, address="tcp://127.0.0.1:5").encoded(), "only that machine can reach it; ask there"),
    ],
)
def test_a_learner_that_cannot_be_asked_from_here_is_named(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / LOCK_FILE).write_bytes(content)
    with pytest.raises(UsageError, match=message):
        learner_of_run(tmp_path)


@pytest.mark.parametrize(
    "address", ["tcp://far:5555; touch x", "tcp://$(id):5555", "http://far/", "far:5555", "tcp://far:0"]
)
@pytest.mark.parametrize("which", ["address", "here"])
def test_an_owner_has_no_address_that_is_none(tmp_path: Path, address: str, which: str) -> None:
    """A command connects to it, and the dashboard shows it as a word to type."""
    named = replace(ELSEWHERE, **{"address": "tcp://far:5555", "here": "tcp://far:5555", "keys": "/k", which: address})
    (tmp_path / LOCK_FILE).write_bytes(named.encoded())
    assert owner_of(tmp_path) == ELSEWHERE
    with pytest.raises(UsageError, match="cannot be asked"):
        learner_of_run(tmp_path)


def test_a_learner_elsewhere_is_asked_at_its_address(tmp_path: Path) -> None:
    (tmp_path / LOCK_FILE).write_bytes(replace(ELSEWHERE, address="tcp://far:5555").encoded())
    assert learner_of_run(tmp_path) == LearnerOfRun("tcp://far:5555", None, is_here=False)


def test_a_learner_of_this_machine_is_asked_at_its_own_address(tmp_path: Path) -> None:
    with lock(tmp_path) as held:
        held.announce(Listens("tcp://box:5555", "tcp://127.0.0.1:5555", "/home/me/keys"))
        assert learner_of_run(tmp_path) == LearnerOfRun("tcp://127.0.0.1:5555", Path("/home/me/keys"), is_here=True)
        in_a_container = replace(owner_of(tmp_path), network_namespace="net:[1]")
    (tmp_path / LOCK_FILE).write_bytes(in_a_container.encoded())
    assert learner_of_run(tmp_path) == LearnerOfRun("tcp://box:5555", Path("/home/me/keys"), is_here=False)
    (tmp_path / LOCK_FILE).write_bytes(replace(in_a_container, address="tcp://127.0.0.1:5555").encoded())
    with pytest.raises(UsageError, match="only that machine can reach it"):
        learner_of_run(tmp_path)


@pytest.mark.process
@pytest.mark.parametrize("address", ["", "ipc:///tmp/x", "tcp://127.0.0.1:5555"])
def test_a_process_that_is_gone_trains_nothing(tmp_path: Path, address: str) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    with lock(tmp_path):
        mine = replace(owner_of(tmp_path), pid=ended.pid, address=address)
    (tmp_path / LOCK_FILE).write_bytes(mine.encoded())
    with pytest.raises(UsageError, match=rf"no process trains it now; process {ended.pid} on \S+ did, and is gone"):
        learner_of_run(tmp_path)
    (tmp_path / LOCK_FILE).write_bytes(replace(mine, pid_namespace="pid:[1]").encoded())
    assert str(living_owner(tmp_path, time.time())).startswith(f"process {ended.pid}"), "a container has other numbers"


def test_a_copy_of_a_folder_is_not_trained_by_the_process_that_trains_the_original(tmp_path: Path) -> None:
    original, copy, renamed = (tmp_path / name for name in ("original", "copy", "renamed"))
    original.mkdir()
    with lock(original) as held:
        shutil.copytree(original, copy)
        with pytest.raises(UsageError, match=rf"no process trains it now; it is a copy of .* process {os.getpid()} on"):
            living_owner(copy, time.time())
        assert living_owner(original, time.time()).pid == os.getpid()
        original.rename(renamed)
        assert living_owner(renamed, time.time()).pid == os.getpid()
        original.mkdir()
        held.confirm()
        assert living_owner(original, time.time()).pid == os.getpid(), "the run continues in a new folder"
        elsewhere = replace(owner_of(original), boot_id="another kernel")
    (copy / LOCK_FILE).write_bytes(elsewhere.encoded())
    assert living_owner(copy, time.time()) == elsewhere, "another machine may see other inode numbers"


@pytest.mark.parametrize(
    "wrong",
    [{"host": "here\nmillrace: all is well"}, {"host": "\x1b[2J"}, {"pid": 2**31}, {"pid": 0}, {"pid": -1}, {"count": -1}],
)
def test_a_lock_file_that_no_owner_wrote_names_no_process(tmp_path: Path, wrong: dict[str, Any]) -> None:
    """What it says reaches a terminal, and its process id the system."""
    (tmp_path / LOCK_FILE).write_bytes(replace(ELSEWHERE, **wrong).encoded())
    assert decoded((tmp_path / LOCK_FILE).read_bytes()) is None
    with pytest.raises(UsageError, match="names no process"):
        learner_of_run(tmp_path)
