"""The slots of this machine: each env copy holds the lowest free number, for its port, folder or display.

Rule: no two live env copies that use one file of slots have the same slot. A slot is a lock on one byte of this file, which
stays empty. The lock belongs to an open file and not to a process, so a worker and its supervisor hold it together, and the
kernel frees it when both are gone.

Rule: each user of the machine has their own file, because anyone who can write the file can lock all of it. Users who trust
one another can share one by setting `FILE_VARIABLE` to the same path. A search for a slot ends after `MOST`.

Rule: with a limit K of this machine (`LIMIT_VARIABLE`), the slots are 0 to K - 1. A copy that finds none free waits for
`WAIT_S`; then its worker leaves the run, so that the learner can place its lanes elsewhere, and is restarted when a slot is
free.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import pwd
import socket
import stat
import struct
import threading
import time
from contextlib import suppress
from pathlib import Path

from millrace.protocol.alive import NO_SLOT
from millrace.protocol.errors import UsageError

log = logging.getLogger("millrace.worker")

FILE_VARIABLE = "MILLRACE_SLOTS"
LIMIT_VARIABLE = "MILLRACE_COPIES_PER_MACHINE"
FILE = "/tmp/millrace-slots-{user}"  # not in $TMPDIR, which may differ between the processes of a user
FLAGS = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # a link is not followed, a FIFO does not block
OWN = 0o600  # a mode
SHARED = 0o666  # a mode
MOST = 1 << 16  # slots of a file, as many as there are ports
FLOCK = "hhqqi4x"  # struct flock on Linux: type, whence, start, length, process

TOUCH_EVERY_S = 3600.0
WAIT_S = 30.0  # for a slot; the copies of another worker may take long to close
POLL_S = 0.2


class NoSlot(UsageError):
    """All slots of this machine are taken, and have been for a while."""


class Slots:
    """The slots that one process holds. Thread-safe."""

    def __init__(self, fd: int | None = None, most: int = 0) -> None:
        """`fd`: the file that the supervisor opened. None: open it. Raises `UsageError` if that fails.

        `most`: how many slots the machine has; 0: no limit.
        """
        self.most = most
        """How many slots the machine has; 0: no limit."""
        self.fd = open_slots() if fd is None else fd
        self._taken: set[int] = set()
        self._lock = threading.Lock()

    def take(self) -> int:
        """Hold the lowest free number on this machine, from 0. Give it back when the env copy is closed.

        Raises `NoSlot` if none becomes free within `WAIT_S`, and `UsageError` if there is no limit and all are locked.
        """
        until_s = time.monotonic() + WAIT_S
        said = False
        file = f"{slots_path()}, a file of {_owner(self.fd)}"
        line = f"{NO_SLOT} on {socket.gethostname()}: other env copies hold all {self.most} of {LIMIT_VARIABLE} ({file})"
        while (slot := self._take_now()) is None:
            if not self.most:
                raise UsageError(
                    f"no env copy can get a slot: another process has locked all of {file}; end that process "
                    f"(`lslocks` shows it), or set {FILE_VARIABLE} to a file of your own"
                )
            if time.monotonic() >= until_s:
                raise NoSlot(line)
            if not said:
                log.warning("%s; waiting for one", line)
            said = True
            time.sleep(POLL_S)
        return slot

    def have_room(self, copies: int) -> bool:
        """Whether this many slots are free now."""
        taken = [slot for _ in range(copies) if (slot := self._take_now()) is not None]
        for slot in taken:
            self.give_back(slot)
        return len(taken) == copies

    def _take_now(self) -> int | None:
        with self._lock:
            for slot in range(self.most or MOST):
                if slot not in self._taken and _is_locked_by(self.fd, slot):
                    self._taken.add(slot)
                    touch(self.fd)
                    return slot
            return None

    def give_back(self, slot: int) -> None:
        """Free a slot that `take` returned."""
        with self._lock:
            self._taken.remove(slot)
            _lock(self.fd, fcntl.F_UNLCK, slot, 1)


_of_processes: dict[int, Slots] = {}
"""By process: a fork needs its own, because it shares the open file, and so the locks."""


def slots() -> Slots:
    """The slots of this process."""
    if (own := _of_processes.get(os.getpid())) is None:
        opened = Slots(most=copies_per_machine())
        if (own := _of_processes.setdefault(os.getpid(), opened)) is not opened:  # another thread opened them first
            os.close(opened.fd)
    return own


def share_slots(fd: int) -> None:
    """Hold the slots of this process, a worker, together with its supervisor, which has opened the file."""
    os.set_inheritable(fd, False)
    _of_processes[os.getpid()] = Slots(fd, copies_per_machine())


def copies_per_machine() -> int:
    """How many env copies may live on this machine, in all processes that have this limit; 0: any number.

    Raises `UsageError`.
    """
    text = os.environ.get(LIMIT_VARIABLE) or "0"
    if not (text.isascii() and text.isdecimal() and len(text) < 10 and int(text) <= MOST):
        raise UsageError(f"{LIMIT_VARIABLE}: expected a whole number up to {MOST:,}, or 0 for no limit, got {text!r:.60}")
    return int(text)


def slots_path() -> Path:
    """The file with the slots of this process: one that several users share on purpose, or this user's own."""
    return Path(os.environ.get(FILE_VARIABLE) or FILE.format(user=os.geteuid()))


def open_slots() -> int:
    """A descriptor whose locks belong to it and its copies. Raises `UsageError` if the file or the limit cannot be used."""
    copies_per_machine()  # before any worker starts
    path = slots_path()
    shared = bool(os.environ.get(FILE_VARIABLE))
    mode = SHARED if shared else OWN
    try:
        with suppress(FileExistsError):
            fd = os.open(path, FLAGS | os.O_CREAT | os.O_EXCL, mode)
            os.fchmod(fd, mode)  # whatever the umask
            return fd
        fd = os.open(path, FLAGS)
        status = os.fstat(fd)
        if stat.S_ISREG(status.st_mode) and (shared or status.st_uid == os.geteuid()):
            return fd
        why = f"a file of {_owner(fd)}" if stat.S_ISREG(status.st_mode) else "not a regular file"
        os.close(fd)
    except OSError as error:
        why = os.strerror(error.errno or 0)
    expected = "every user who shares it may write" if shared else f"belongs to {_name(os.geteuid())}"
    line = f"{path}: {why}; it holds the slots of this machine's env copies, so expected a file that {expected}"
    raise UsageError(f"{line}; set {FILE_VARIABLE} to another path, the same for all processes that share slots")


def free_all(fd: int) -> None:
    """Free every slot that is held through this descriptor, also for processes that share it, and close it."""
    _lock(fd, fcntl.F_UNLCK, 0, 0)
    os.close(fd)


def touch(fd: int) -> None:
    """Mark the file as used: otherwise a cleaner of /tmp might delete it, and new processes would see no slot taken."""
    with suppress(OSError):
        if time.time() - os.fstat(fd).st_mtime > TOUCH_EVERY_S:
            os.utime(fd)


def _owner(fd: int) -> str:
    """The owner of the file, in words."""
    return _name(os.fstat(fd).st_uid)


def _name(user: int) -> str:
    """A user, by name if the system knows one."""
    try:
        return f"user {pwd.getpwuid(user).pw_name}"
    except KeyError:
        return f"user {user}"


def _is_locked_by(fd: int, slot: int) -> bool:
    """Lock this slot. False if another process holds it."""
    with suppress(BlockingIOError, PermissionError):
        _lock(fd, fcntl.F_WRLCK, slot, 1)
        return True
    return False


def _lock(fd: int, kind: int, start: int, length: int) -> None:
    """Lock or free this range without waiting. Without open file locks (macOS, gVisor), the locks belong to the process."""
    if hasattr(fcntl, "F_OFD_SETLK"):
        try:
            fcntl.fcntl(fd, fcntl.F_OFD_SETLK, struct.pack(FLOCK, kind, os.SEEK_SET, start, length, 0))
            return
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
    fcntl.lockf(fd, fcntl.LOCK_UN if kind == fcntl.F_UNLCK else fcntl.LOCK_EX | fcntl.LOCK_NB, length, start)
