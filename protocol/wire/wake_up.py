"""How a learner and its worker processes wait for each other's steps: they spin, and then sleep until a pipe wakes them.

This works only on Linux; elsewhere, everything is sent as messages.
"""

from __future__ import annotations

import os
import platform
import select
from collections.abc import Callable
from contextlib import suppress
from enum import IntEnum
from time import perf_counter

# On x86, no core sees a later store before an earlier one. Elsewhere, only a system call orders them, so we don't spin
# there.
CAN_SPIN = platform.machine() in {"x86_64", "AMD64", "i686"}
SPIN_S = 0.0002  # long enough for a learner that only computes its next action; sleeping and waking costs 50 µs
BUSY_CORE_S = 0.00005  # if one turn of spinning takes longer, another process ran in between and needs this core
MAX_SKIPPED_SPINS = 63  # largest number of waits without spinning between two attempts to spin


class WakeReason(IntEnum):
    """Why a sleeper was woken."""

    NONE = 0
    STEP = 1
    MESSAGE = 2


class WakePipe:
    """A pipe by which one side wakes the other: one side writes a byte, and the other sleeps until it can read it.

    It is a pipe because Linux assumes that a process that writes to a pipe is about to sleep, so the woken process starts on
    the same core as soon as the writer sleeps. A process woken by an eventfd or a semaphore may have to wait for a core on
    which a third process spins.
    """

    def __init__(self, *, read_fd: int = -1, write_fd: int = -1) -> None:
        """Create a pipe, or use the one or two ends of a pipe that this process inherited."""
        self.read_fd, self.write_fd = (
            os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC) if read_fd == write_fd == -1 else (read_fd, write_fd)
        )
        self._poll = select.poll()
        if self.read_fd != -1:
            self._poll.register(self.read_fd, select.POLLIN)

    def wake(self, reason: WakeReason = WakeReason.STEP) -> None:
        """Wake the other side, now or when it next waits."""
        with suppress(BlockingIOError, BrokenPipeError):  # full: the reader wakes anyway; broken: the reader is gone
            os.write(self.write_fd, _BYTES[reason])

    def wait(self, timeout_s: float) -> WakeReason:
        """Sleep until woken, for at most `timeout_s` seconds. Returns the reason; `MESSAGE` takes precedence over `STEP`.

        If the reader has noticed a step without sleeping, the step's byte is still in the pipe, and the next `wait` returns
        immediately.
        """
        if not self._poll.poll(timeout_s * 1000):
            return WakeReason.NONE
        try:
            received = os.read(self.read_fd, 4096)
        except BlockingIOError:
            return WakeReason.NONE
        return WakeReason(max(received, default=0))

    def close(self) -> None:
        """Close the descriptors."""
        for fd in {self.read_fd, self.write_fd} - {-1}:
            os.close(fd)
        self.read_fd = self.write_fd = -1


_BYTES = {reason: bytes([reason]) for reason in WakeReason}


class SpinWait:
    """Spins for a short time before it sleeps. Each time that spinning was in vain, it skips spinning in more of the waits
    that follow.

    Linux may ignore `sched_yield` for a while; only a sleeping process is certain to free its core. Spinning therefore stops
    after the first turn that takes so long that another process must have run on this core.
    """

    def __init__(self) -> None:
        self._skipped = self._to_skip = 0

    def wait(self, seen: Callable[[], bool], seconds: float) -> bool:
        """Spin until `seen` returns True, for at most this many seconds. Returns whether `seen` returned True."""
        if seen():
            return True
        if not CAN_SPIN or seconds <= 0:
            return False
        if self._to_skip:
            self._to_skip -= 1
            return False
        now = perf_counter()
        until = now + seconds
        while now < until:
            os.sched_yield()
            before = now
            now = perf_counter()
            if seen():
                self._skipped = 0
                return True
            if now - before > BUSY_CORE_S:
                break
        self._skipped = self._to_skip = min(2 * self._skipped + 1, MAX_SKIPPED_SPINS)
        return False
