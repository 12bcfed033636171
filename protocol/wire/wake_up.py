"""How a learner and its worker processes wait for each other's steps: a pipe that wakes a sleeper, and spinning before that.

Linux only; elsewhere everything travels as messages.
"""

from __future__ import annotations

import os
import platform
import select
from collections.abc import Callable
from contextlib import suppress
from enum import IntEnum
from time import perf_counter

# x86 makes an earlier store visible before a later one. Other processors need a system call for that: there is no spinning.
CAN_SPIN = platform.machine() in {"x86_64", "AMD64", "i686"}
SPIN_S = 0.0002  # a learner that only computes its next action is back by then; sleeping and waking costs 50 µs
WANTED_S = 0.00005  # a spin turn that takes longer means that another process ran meanwhile and needs this core
MOST_LEFT_OUT = 63  # waits without spinning between two tries to spin


class WakeReason(IntEnum):
    """What a bell was rung for."""

    NONE = 0
    STEP = 1
    MESSAGE = 2


class WakePipe:
    """A pipe: rung by one side, which writes, and heard by the other, which reads.

    A pipe, for Linux takes it that who writes to one is about to wait: whom it wakes begins on the same core as soon as the
    other sleeps. Whom an eventfd or a semaphore wakes may be made to wait for a core where a third one spins.
    """

    def __init__(self, *, read_fd: int = -1, write_fd: int = -1) -> None:
        """A new one; or one of the ends, which was handed over."""
        self.read_fd, self.write_fd = (
            os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC) if read_fd == write_fd == -1 else (read_fd, write_fd)
        )
        self._poll = select.poll()
        if self.read_fd != -1:
            self._poll.register(self.read_fd, select.POLLIN)

    def wake(self, reason: WakeReason = WakeReason.STEP) -> None:
        """Wake whoever waits, or will."""
        with suppress(BlockingIOError, BrokenPipeError):  # full: it will wake; broken: nobody is left to
            os.write(self.write_fd, _BYTES[reason])

    def wait(self, timeout_s: float) -> WakeReason:
        """Sleep until it is rung, at most `timeout_s`; of all that it was rung for, a message counts most.

        Rung for a step that was seen without sleeping, it wakes the next sleeper for nothing.
        """
        if not self._poll.poll(timeout_s * 1000):
            return WakeReason.NONE
        try:
            strokes = os.read(self.read_fd, 4096)
        except BlockingIOError:
            return WakeReason.NONE
        return WakeReason(max(strokes, default=0))

    def close(self) -> None:
        """Let go of it."""
        for fd in {self.read_fd, self.write_fd} - {-1}:
            os.close(fd)
        self.read_fd = self.write_fd = -1


_BYTES = {reason: bytes([reason]) for reason in WakeReason}


class SpinWait:
    """Waiting awake for what is expected at once. While it does not come at once, this is tried less and less often.

    Yielding is a request that Linux may decline for a while: only who sleeps surely makes room. So the first turn that takes
    long, because somebody else wanted this core, ends it.
    """

    def __init__(self) -> None:
        self._left_out = self._to_leave_out = 0

    def wait(self, seen: Callable[[], bool], seconds: float) -> bool:
        """Whether it was seen within `seconds`."""
        if seen():
            return True
        if not CAN_SPIN or seconds <= 0:
            return False
        if self._to_leave_out:
            self._to_leave_out -= 1
            return False
        now = perf_counter()
        until = now + seconds
        while now < until:
            os.sched_yield()
            before, now = now, perf_counter()
            if seen():
                self._left_out = 0
                return True
            if now - before > WANTED_S:
                break
        self._left_out = self._to_leave_out = min(2 * self._left_out + 1, MOST_LEFT_OUT)
        return False
