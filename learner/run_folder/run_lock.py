"""The lock of a run folder, which ensures that only one process trains a run at a time.

Rule: the file `run.lock` names the owner. On a single machine, the system's lock on this file (flock) decides; the kernel
releases it when the process dies, however it dies. Machines that share the folder may not see each other's system locks, or
may still see the lock of a machine that died. Therefore, the owner also rewrites the file every few seconds (`lease.py`); an
owner on another machine that stops doing so counts as dead. The lock of a dead owner is taken over. An owner that finds the
file missing recreates it, unless it hasn't rewritten the file for so long that another process may have taken over the run
and ended since. Commands that only read a run folder don't need the lock (`living_owner.py`).
"""

from __future__ import annotations

import fcntl
import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from msgspec.structs import replace

from millrace.learner.run_folder.atomic_write import TEMPORARY
from millrace.learner.run_folder.lease import LeaseWatch, Listens, Owner, Unreachable, Verdict, decoded
from millrace.learner.run_folder.owner_process import inode, is_gone, new_owner
from millrace.learner.run_folder.regular_files import open_regular, read
from millrace.protocol.errors import RunError, RunTakenOver, UsageError

log = logging.getLogger("millrace.learner")

LOCK_FILE = "run.lock"


class SystemLock(Enum):
    """Who has the system's lock on a file."""

    OURS = "this process"
    OTHERS = "another process, or a machine that died before it could release the lock"
    NOBODYS = "nobody, because the file system has no locks"


class Claim(Enum):
    """How a process that wants the lock may get it."""

    REFUSED = "another process has it"
    NEW = "nobody had it"
    AT_ONCE = "its owner is dead"
    AFTER_WAIT = "it is not known whether its owner is alive"


def claim(locked: SystemLock, owner: Owner | None, boot_id: str, *, made: bool) -> Claim:
    """How this process may get the lock. `owner` is the owner that the file names, and `boot_id` is this machine's boot id.

    `made` is True if this process has created the file.
    """
    here = owner is not None and owner.boot_id == boot_id
    if locked is SystemLock.OTHERS and (here or owner is None):
        return Claim.REFUSED
    if made:
        return Claim.NEW
    if locked is SystemLock.OURS and here:
        return Claim.AT_ONCE  # because the kernel has released the system's lock of the owner, which is dead
    return Claim.AFTER_WAIT


class Pace(NamedTuple):
    """How often an owner rewrites its lock, and how long an observer waits for that, in seconds."""

    rewrite_every: float = 3.0
    dead_after: float = 30.0
    look_every: float = 0.5
    confirm_after: float = 1.0
    """How long to wait, after taking over another machine's lock, before checking that no third machine took it too."""


PACE = Pace()
JOIN_S = 5.0  # how long to wait for the thread at the end, because a file system that doesn't answer must not block the end


class RunLock:
    """The lock of one run folder, held inside the context."""

    def __init__(
        self,
        folder: Path,
        pace: Pace = PACE,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self._folder = folder
        self._path = folder / LOCK_FILE
        self._pace = pace
        self._clock = clock
        self._sleep = sleep
        self._wall_clock = wall_clock
        self._owner = new_owner(folder)
        self._file = -1
        self._seen_s = 0.0  # wall-clock time of the last look at the file that showed that the run is still ours
        self._lost = ""  # why the run is no longer ours
        self._stop = threading.Event()
        self._writing = threading.Lock()  # guards this object, because the thread and `confirm` both rewrite the file
        self._thread = threading.Thread(target=self._rewrite_often, name="run-lock", daemon=True)

    def __enter__(self) -> Self:
        """Take the lock.

        Raises `UsageError`, which names the owner, if another process has the lock, and `RunError` if the lock file cannot
        be written.
        """
        try:
            self._take()
        except OSError as error:
            raise RunError(f"{self._path} not written: {error.strerror}") from error
        self._seen_s = self._wall_clock()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Release the lock and remove its file, unless another process has taken it over."""
        self._stop.set()
        self._thread.join(timeout=JOIN_S)
        with suppress(OSError):
            if self._is_ours():
                self._path.unlink()
        self._close()

    def announce(self, where: Listens | Unreachable) -> None:
        """Write to the lock file where the learner listens for `millrace status`, or why it cannot be asked."""
        with self._writing:
            self._owner = self._owner.listening(where)
        self._rewrite()

    @property
    def taken_over(self) -> bool:
        """Whether another process is known to have taken over the run. Reads no file."""
        return bool(self._lost)

    def check(self) -> None:
        """Raise `RunTakenOver` if another process is known to have taken over the run. Reads no file."""
        if self._lost:
            raise RunTakenOver(f"run {self._folder}: {self._lost}")

    def confirm(self) -> None:
        """Read the lock file. Raises `RunTakenOver` if another process has taken over the run. Called before writing."""
        self._rewrite()
        self.check()

    # ---------------------------------------------------------------- taking the lock

    def _take(self) -> None:
        while True:
            try:
                self._file = open_regular(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
                made = True
            except FileExistsError:
                try:
                    self._file = open_regular(self._path, os.O_RDWR)
                    made = False
                except FileNotFoundError:
                    continue  # its owner has released the lock in between
            try:
                if self._take_open_file(made=made):
                    return
            except BaseException as error:
                if made and isinstance(error, OSError):  # for example, because the disk is full
                    self._path.unlink(missing_ok=True)
                self._close()
                raise
            self._close()

    def _take_open_file(self, *, made: bool) -> bool:
        """Take the lock of the open file. Returns False if the lock's owner released it meanwhile.

        Raises `UsageError` if the owner is alive.
        """
        locked = self._lock_by_system()
        if not self._is_open_file():
            return False
        owner = decoded(self._read_open_file())
        match claim(locked, owner, self._owner.boot_id, made=made):
            case Claim.REFUSED:
                raise self._refusal(owner)
            case Claim.NEW:
                self._write()
                return True
            case Claim.AT_ONCE:
                self._write()
            case Claim.AFTER_WAIT:
                self._wait_until_dead(owner)
                if not self._is_open_file():
                    return False
                if locked is SystemLock.OTHERS:
                    self._replace_file()
                else:
                    self._write()
                self._sleep(self._pace.confirm_after)
                if not self._is_ours():
                    raise self._refusal(decoded(self._read_open_file()))
        log.warning("run %s: %s held its lock and is gone; this process takes over", self._folder, owner or "a process")
        return True

    def _lock_by_system(self) -> SystemLock:
        """Try to take the system's lock on the open file. Returns who has the lock now."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return SystemLock.OTHERS
        except OSError:
            return SystemLock.NOBODYS
        return SystemLock.OURS

    def _replace_file(self) -> None:
        """Replace the file with a new one, because a machine that died still has the system's lock on the old one."""
        new = self._path.with_name(f"{LOCK_FILE}-{self._owner.token}{TEMPORARY}")
        file = open_regular(new, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        self._close()
        self._file = file
        self._lock_by_system()
        try:
            self._write()
            new.replace(self._path)
        except OSError:
            new.unlink(missing_ok=True)
            raise

    def _wait_until_dead(self, owner: Owner | None) -> None:
        """Wait until the content has stayed the same for long enough, or the file is gone.

        Raises `UsageError` if the content changes, because the owner is then alive.
        """
        pace = self._pace
        log.warning(
            "run %s: its lock names %s; waiting up to %.0f s to see whether it lives",
            self._folder,
            owner or "no process",
            pace.dead_after,
        )
        watch = LeaseWatch(self._read_open_file(), self._clock(), pace.dead_after)
        while True:
            self._sleep(pace.look_every)
            try:
                content = read(self._path)  # opens it again, because a file system may cache the content of an open file
            except FileNotFoundError:
                return  # the owner has released the lock
            match watch.judge(content, self._clock()):
                case Verdict.ALIVE:
                    raise self._refusal(decoded(content) or owner)
                case Verdict.DEAD:
                    return

    def _refusal(self, owner: Owner | None) -> UsageError:
        if owner is not None and is_gone(owner):  # any process that can read the file can lock it
            return UsageError(
                f"run {self._folder}: {owner}, which trained it, is gone, but another process has locked "
                f"{self._path}; end that process (`lslocks` shows it) or delete the file, then resume"
            )
        who = str(owner) if owner is not None else "another process"
        here = owner is not None and owner.boot_id == self._owner.boot_id
        how = f"kill {owner.pid}" if here and owner is not None else "end that process"
        return UsageError(f"run {self._folder}: {who} is training it; wait until it ends, or end it ({how}), then resume")

    # ---------------------------------------------------------------- holding the lock

    def _rewrite_often(self) -> None:
        while not self._stop.wait(self._pace.rewrite_every):
            self._rewrite()

    def _rewrite(self) -> None:
        with self._writing, suppress(OSError):  # a file system that fails now may work next time
            if self._lost:
                return
            began_s = self._wall_clock()
            try:
                owner = decoded(read(self._path))
            except FileNotFoundError:
                self._make_again()
            else:
                if owner is not None and owner.token != self._owner.token:
                    self._lost = (
                        f"{owner} took it over, because this process seemed dead for {self._pace.dead_after:.0f} s; "
                        "it continues there, and nothing more is written here"
                    )
                    return
                self._owner = replace(self._owner, count=self._owner.count + 1)
                self._write()
            self._seen_s = began_s

    def _make_again(self) -> None:
        """Recreate the file after somebody has removed it, unless the whole folder is gone.

        Doesn't recreate the file if another process had enough time to take over the run, because that process may have
        removed the file when it ended.
        """
        unseen_s = self._wall_clock() - self._seen_s  # other clocks may stop while the machine is suspended
        if unseen_s >= self._pace.dead_after:
            self._lost = (
                f"{LOCK_FILE} is gone, and this process could not renew it for {unseen_s:.0f} s; another process may have "
                "continued the run meanwhile, and nothing more is written here"
            )
            return
        if not self._folder.is_dir():
            return
        file = open_regular(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        self._close()
        self._file = file
        self._lock_by_system()
        self._owner = replace(self._owner, folder=inode(self._folder))
        self._write()

    def _write(self) -> None:
        os.pwrite(self._file, self._owner.encoded(), 0)
        os.fdatasync(self._file)  # so that other machines see the new content

    def _read_open_file(self) -> bytes:
        return os.pread(self._file, 1 << 16, 0)

    def _is_ours(self) -> bool:
        owner = decoded(read(self._path))
        return owner is not None and owner.token == self._owner.token

    def _is_open_file(self) -> bool:
        """Whether the open file is still the one at this path. The owner may have removed the file."""
        with suppress(FileNotFoundError):
            return os.path.samestat(os.fstat(self._file), os.lstat(self._path))
        return False

    def _close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
