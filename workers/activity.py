"""A worker's current activity, in a page of memory that the worker shares with its supervisor.

Rule: only the worker writes to the page, and the supervisor only reads it. The worker writes what it is doing, since when,
and how many calls to the environment have returned. When a learner welcomes it, it also writes how long a call may take, and
before it leaves on purpose, it writes its exit code. The supervisor can therefore see what a worker is doing even while a C
extension holds the worker's interpreter lock. The memory is an unlinked file that a child process inherits. When the
supervisor sends a signal, the worker writes the stacks of its threads after the page, into the same file.

A worker in a thread has its own page, which isn't shared.
"""

from __future__ import annotations

import faulthandler
import math
import mmap
import os
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import NamedTuple, get_args

from millrace.protocol.call_timeouts import OF_POLICY, OUR_CODE, CallTimeouts, Doing

PAGE_BYTES = 4096
MAX_STACK_BYTES = 64_000
STACK_SIGNAL = getattr(signal, "SIGQUIT", None)  # by convention, it makes a program write each thread's stack
DOINGS: tuple[Doing, ...] = get_args(Doing)
(
    STARTING,
    WAITING,
    DESCRIBING,
    MAKING,
    PREPARING,
    RESETTING,
    STEPPING,
    REPEATING,
    ACTING,
    EVALUATING,
    CLOSING,
) = range(len(DOINGS))
# The index of each number in the page.
DOING, SINCE_S, ENV_CALLS, LEAVES, LEAVES_SINCE_S, START_TIMEOUT_S, STEP_TIMEOUT_S = range(7)
MOST_CALLS = 2**53


class Activity:
    """The worker's side of the page. Times are those of `perf_counter`, a clock that worker and supervisor share."""

    def __init__(self, fd: int | None = None) -> None:
        """`fd` is the file of a page that the supervisor made; if it is None, the page belongs to this thread alone."""
        page = memoryview(mmap.mmap(-1 if fd is None else fd, PAGE_BYTES))
        self.numbers = page.cast("q")
        self.seconds = page.cast("d")
        self.begin(STARTING)
        if fd is not None and STACK_SIGNAL is not None:
            os.lseek(fd, PAGE_BYTES, os.SEEK_SET)
            faulthandler.register(STACK_SIGNAL, file=fd, all_threads=True)

    def begin(self, doing: int) -> None:
        """Record that the worker begins this activity, one of the constants above.

        The time is written first, so that no reader sees the new activity with the time of the old one.
        """
        self.seconds[SINCE_S] = perf_counter()
        self.numbers[DOING] = doing

    def end(self, calls: int = 1) -> None:
        """Record that this many calls to the environment have returned, and that the worker runs its own code again."""
        self.numbers[ENV_CALLS] += calls
        self.begin(WAITING)

    @contextmanager
    def during(self, doing: int) -> Iterator[None]:
        """A context in which the worker makes one call to the environment or to a policy. Contexts may be nested."""
        before = self.numbers[DOING]
        self.begin(doing)
        try:
            yield
        finally:
            self.end(calls=0 if DOINGS[doing] in OF_POLICY else 1)
            if DOINGS[before] not in OUR_CODE:
                self.begin(before)

    def limit(self, timeouts: CallTimeouts) -> None:
        """Set how long a call to user code may take from now on. There is no limit until this method is first called."""
        self.seconds[START_TIMEOUT_S] = timeouts.start_s
        self.seconds[STEP_TIMEOUT_S] = timeouts.step_s

    def leave(self, exit_code: int) -> None:
        """Record that the worker is about to leave on purpose, with this exit code."""
        self.seconds[LEAVES_SINCE_S] = perf_counter()
        self.numbers[LEAVES] = exit_code + 1


_of_thread = threading.local()


def activity() -> Activity:
    """The page of the worker that runs in this thread."""
    activity_here: Activity | None = getattr(_of_thread, "activity", None)
    if activity_here is None:
        activity_here = _of_thread.activity = Activity()
    return activity_here


def share_activity(page: Activity) -> None:
    """Let the worker in this thread write to this page. Call this before you make the worker, because the worker's parts
    look up the page only once, when they are made.
    """
    _of_thread.activity = page


class Reading(NamedTuple):
    """The content of a page at one moment."""

    doing: Doing
    for_s: float
    env_calls: int
    exit_code: int | None
    """exit code with which the worker leaves on purpose; None if it isn't leaving"""
    leaves_for_s: float
    """seconds since the worker began to leave"""
    timeouts: CallTimeouts
    """the timeouts of the worker's run"""


class ActivityReader:
    """The supervisor's side of the page."""

    def __init__(self, page: Activity | None = None) -> None:
        """`page` is the page of a worker in a thread. If it is None, make a page for a child process to inherit
        through `fd`.
        """
        self.fd = -1
        if page is None:
            self.fd = _anonymous_file()
            os.ftruncate(self.fd, PAGE_BYTES)
            memory = memoryview(mmap.mmap(self.fd, PAGE_BYTES))
            self._numbers = memory.cast("q")
            self._seconds = memory.cast("d")
        else:
            self._numbers = page.numbers
            self._seconds = page.seconds

    def read(self, now: float) -> Reading:
        """Read the page. Environment code could write to it too, so every value is clipped to its valid range."""
        timeouts = self.timeouts()  # read before the activity, so that a call is never judged by the limits of a later run
        code = self._numbers[DOING]  # read before the time: see `Activity.begin`
        doing = DOINGS[code] if 0 <= code < len(DOINGS) else "waiting"
        leaves = self._numbers[LEAVES]
        return Reading(
            doing=doing,
            for_s=_since(self._seconds[SINCE_S], now) if self._seconds[SINCE_S] else 0.0,
            env_calls=min(max(0, self._numbers[ENV_CALLS]), MOST_CALLS),
            exit_code=leaves - 1 if 0 < leaves <= 256 else None,
            leaves_for_s=_since(self._seconds[LEAVES_SINCE_S], now),
            timeouts=timeouts,
        )

    def timeouts(self) -> CallTimeouts:
        """How long a call may take in the worker's run. There is no limit until a learner has welcomed the worker."""
        return CallTimeouts(_limit_s(self._seconds[START_TIMEOUT_S]), _limit_s(self._seconds[STEP_TIMEOUT_S]))

    def stacks(self) -> str:
        """The stacks of the worker's threads, if it has written them."""
        return os.pread(self.fd, MAX_STACK_BYTES, PAGE_BYTES).decode(errors="replace") if self.fd >= 0 else ""

    def close(self) -> None:
        """Close the descriptor."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


def _since(then: float, now: float) -> float:
    return min(max(0.0, now - then), 1e9) if math.isfinite(then) else 0.0


def _limit_s(seconds: float) -> float:
    return seconds if 0.0 < seconds < math.inf else 0.0


def _anonymous_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("millrace-activity", os.MFD_CLOEXEC)
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
