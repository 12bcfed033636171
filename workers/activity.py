"""What a worker is doing, in a page of memory that it shares with its supervisor.

Rule: each number has one writer. The worker writes what it is doing, since when, and how many calls of the environment have
returned; when a learner welcomes it, how long a call may take; before it leaves on purpose, its exit code. The supervisor
only reads. So it sees what a worker is doing even while a C extension holds the worker's interpreter lock. The memory is an
unlinked file that a child process inherits. The worker's stacks are written behind the page when the supervisor asks for
them by a signal.

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
STACK_SIGNAL = getattr(signal, "SIGQUIT", None)  # by convention: write the stack of each thread
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
# Places of the numbers in the page.
DOING, SINCE_S, ENV_CALLS, LEAVES, LEAVES_SINCE_S, START_TIMEOUT_S, STEP_TIMEOUT_S = range(7)
MOST_CALLS = 2**53


class Activity:
    """The worker's side of the page. perf_counter and the supervisor's clock are the same clock."""

    def __init__(self, fd: int | None = None) -> None:
        """`fd`: the page that the supervisor made. None: a page of this thread alone."""
        page = memoryview(mmap.mmap(-1 if fd is None else fd, PAGE_BYTES))
        self.numbers = page.cast("q")
        self.seconds = page.cast("d")
        self.begin(STARTING)
        if fd is not None and STACK_SIGNAL is not None:
            os.lseek(fd, PAGE_BYTES, os.SEEK_SET)
            faulthandler.register(STACK_SIGNAL, file=fd, all_threads=True)

    def begin(self, doing: int) -> None:
        """Record that the worker now does this. The time is written first, so that no reader sees the new activity with the
        time of the old one.
        """
        self.seconds[SINCE_S] = perf_counter()
        self.numbers[DOING] = doing

    def end(self, calls: int = 1) -> None:
        """Record that this many calls of the environment have returned, and that the worker runs its own code again."""
        self.numbers[ENV_CALLS] += calls
        self.begin(WAITING)

    @contextmanager
    def during(self, doing: int) -> Iterator[None]:
        """While it is entered, the worker makes one call of the environment or of a policy; may be nested."""
        before = self.numbers[DOING]
        self.begin(doing)
        try:
            yield
        finally:
            self.end(calls=0 if DOINGS[doing] in OF_POLICY else 1)
            if DOINGS[before] not in OUR_CODE:
                self.begin(before)

    def limit(self, timeouts: CallTimeouts) -> None:
        """Set how long a call of user code may take from now on. Before, it may take any time."""
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
    """Let the worker in this thread write to this page. Call this before it makes anything."""
    _of_thread.activity = page


class Reading(NamedTuple):
    """The content of a page at one moment."""

    doing: Doing
    for_s: float
    env_calls: int
    exit_code: int | None
    """exit code with which the worker leaves on purpose; None if it doesn't"""
    leaves_for_s: float
    """seconds since it began to leave"""
    timeouts: CallTimeouts
    """the timeouts of its run"""


class ActivityReader:
    """The supervisor's side of the page."""

    def __init__(self, page: Activity | None = None) -> None:
        """`page`: the page of a thread. None: make one for a child process, which inherits `fd`."""
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
        """What the worker is doing. Environment code can write to the page, so every value is forced into its bounds."""
        timeouts = self.timeouts()  # read before the activity, so that a call is never judged by the limits of a later run
        code = self._numbers[DOING]  # before the time: see `Activity.begin`
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
        """How long a call may take in the worker's run; without limit before it is welcomed to a run."""
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
