"""The slots of this machine: each env copy takes the lowest free number, from which it can derive a port, folder or display.

Rule: no two live env copies that use the same slots file have the same slot. A slot is a lock on one byte of this file,
which stays empty. The lock belongs to an open file and not to a process, so a worker and its supervisor hold it together,
and the kernel frees it when both are gone.

Rule: each user of the machine has their own file, because anyone who can write to the file can lock all of it. Users who
trust one another can share a file by setting `FILE_VARIABLE` to the same path. A file has `MOST` slots.

Rule: if the machine has a limit of K copies (`LIMIT_VARIABLE`), the slots are 0 to K - 1. A copy that finds no free slot
waits for `WAIT_S` seconds. Then its worker leaves the run, so that the learner can place the worker's lanes elsewhere, and
is restarted when a slot is free.
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
FLAGS = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # neither follows links nor blocks on a FIFO
OWN = 0o600  # mode of a user's own file
SHARED = 0o666  # mode of a file that users share
MOST = 1 << 16  # number of slots in a file, as many as there are ports
FLOCK = "hhqqi4x"  # struct flock on Linux: type, whence, start, length, process

TOUCH_EVERY_S = 3600.0
WAIT_S = 30.0  # how long to wait for a slot; another worker's copies may take long to close
POLL_S = 0.2


class NoSlot(UsageError):
    """All slots of this machine have been taken for a while."""


class Slots:
    """The slots that one process holds. Thread-safe."""

    def __init__(self, fd: int | None = None, most: int = 0) -> None:
        """`fd` is the slots file if the supervisor has opened it; if it is None, open it.

        `most` is the number of slots of the machine; 0 means no limit. Raises `UsageError` if the file can't be opened.
        """
        self.most = most
        """Number of slots of the machine; 0: no limit."""
        self.fd = open_slots() if fd is None else fd
        self._taken: set[int] = set()
        self._lock = threading.Lock()

    def take(self) -> int:
        """Take the lowest free slot of this machine, and return its number. Give it back when the env copy is closed.

        Raises `NoSlot` if no slot becomes free within `WAIT_S` seconds, and `UsageError` if there is no limit and all slots
        are locked.
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
        """Whether at least this many slots are free now."""
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
"""The keys are process ids, because a fork needs its own `Slots`: it shares its parent's open file, and with it the locks.
"""


def slots() -> Slots:
    """The slots of this process."""
    if (own := _of_processes.get(os.getpid())) is None:
        opened = Slots(most=copies_per_machine())
        if (own := _of_processes.setdefault(os.getpid(), opened)) is not opened:  # another thread opened them first
            os.close(opened.fd)
    return own


def share_slots(fd: int) -> None:
    """Let this worker process hold its slots together with its supervisor. `fd` is the file that the supervisor opened."""
    os.set_inheritable(fd, False)
    _of_processes[os.getpid()] = Slots(fd, copies_per_machine())


def copies_per_machine() -> int:
    """How many env copies may live on this machine, in all processes with this limit; 0 means any number.

    Raises `UsageError` if the environment variable is not a valid number.
    """
    text = os.environ.get(LIMIT_VARIABLE) or "0"
    if not (text.isascii() and text.isdecimal() and len(text) < 10 and int(text) <= MOST):
        raise UsageError(f"{LIMIT_VARIABLE}: expected a whole number up to {MOST:,}, or 0 for no limit, got {text!r:.60}")
    return int(text)


def slots_path() -> Path:
    """The slots file of this process: the one that `FILE_VARIABLE` names, or this user's own."""
    return Path(os.environ.get(FILE_VARIABLE) or FILE.format(user=os.geteuid()))


def open_slots() -> int:
    """Open the slots file. Locks belong to the returned descriptor and its duplicates.

    Raises `UsageError` if the file or the limit cannot be used.
    """
    copies_per_machine()  # checks the limit before any worker starts
    path = slots_path()
    shared = bool(os.environ.get(FILE_VARIABLE))
    mode = SHARED if shared else OWN
    try:
        with suppress(FileExistsError):
            fd = os.open(path, FLAGS | os.O_CREAT | os.O_EXCL, mode)
            os.fchmod(fd, mode)  # so that the mode doesn't depend on the umask
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
    """Free every slot that is held through this descriptor, including those of processes that share it, and close it."""
    _lock(fd, fcntl.F_UNLCK, 0, 0)
    os.close(fd)


def touch(fd: int) -> None:
    """Mark the file as used. Otherwise, a cleaner of /tmp might delete it, and new processes would find all slots free."""
    with suppress(OSError):
        if time.time() - os.fstat(fd).st_mtime > TOUCH_EVERY_S:
            os.utime(fd)


def _owner(fd: int) -> str:
    """The owner of the file, in words."""
    return _name(os.fstat(fd).st_uid)


def _name(user: int) -> str:
    """A user in words: by name if the system knows it, else by number."""
    try:
        return f"user {pwd.getpwuid(user).pw_name}"
    except KeyError:
        return f"user {user}"


def _is_locked_by(fd: int, slot: int) -> bool:
    """Try to lock this slot. Returns False if another process holds it."""
    with suppress(BlockingIOError, PermissionError):
        _lock(fd, fcntl.F_WRLCK, slot, 1)
        return True
    return False


def _lock(fd: int, kind: int, start: int, length: int) -> None:
    """Lock or free this range of bytes without waiting.

    On systems without open file description locks (macOS, gVisor), the locks belong to the process.
    """
    if hasattr(fcntl, "F_OFD_SETLK"):
        try:
            fcntl.fcntl(fd, fcntl.F_OFD_SETLK, struct.pack(FLOCK, kind, os.SEEK_SET, start, length, 0))
            return
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
    fcntl.lockf(fd, fcntl.LOCK_UN if kind == fcntl.F_UNLCK else fcntl.LOCK_EX | fcntl.LOCK_NB, length, start)
