"""Handles SIGINT, SIGTERM and SIGHUP in a learner: the first signal ends the run, within the grace time if there is one.

Rule: after the first signal, the current update may still finish; `time_is_up` says when it must be abandoned, so that the
rest of the grace time is enough to save. A second SIGINT (Ctrl-C) ends the run at once. If there is a grace time, further
SIGTERMs and SIGHUPs change nothing, because they are often sent both to a process and to its group, and the time is limited
anyway. SIGHUP means that the terminal is gone. A learner that was started to ignore SIGHUP (`nohup`) keeps ignoring it.

Rule: where there is nothing to save, a signal ends the program as well, with the same exit code (`stopped_by_signals`).
"""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from time import monotonic
from types import FrameType, TracebackType
from typing import Self

from millrace.protocol.machine.deferred_signals import SIGNALS, Handler, heeded, known_handlers, put_back_late

FOR_SAVING = 0.5  # the share of the grace time that an update must leave for saving
SAVE_TAKES = 1.5  # the time allowed for saving, as a multiple of the longest save so far

_stopped = False  # whether `Stopped` was raised; other code, such as an import or a finalizer, may have swallowed it


class Stopped(KeyboardInterrupt):
    """A signal has stopped the program.

    It is a separate class, because a plain KeyboardInterrupt may pass through `exec`, for example in the definition of a
    dataclass. Python then ends as if the signal had killed it, even if the program handles the exception.
    """


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Inside this context, the first signal raises `Stopped`.

    Later signals are ignored, because they would only cut the clean-up short. Signals that were blocked are delivered on
    entry. After the exit, signals stay ignored, because Python would remove any other handler when the interpreter ends.
    """
    global _stopped

    def stop(number: int, frame: FrameType | None) -> None:
        global _stopped
        if not _stopped:
            _stopped = True
            raise Stopped

    _set(stop, heeded())
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        yield
    finally:
        _set(signal.SIG_IGN, heeded())
        _stopped = False


def _set(handler: Handler, signals: Iterable[int]) -> None:
    for each in signals:
        signal.signal(each, handler)


class Interrupts:
    """Records signals inside the context, and restores the handlers afterwards. Does nothing outside the main thread."""

    def __init__(self, grace_s: float = 0.0) -> None:
        """`grace_s` is the number of seconds from the first signal to the end of the process; 0 means no limit."""
        self._grace_s = grace_s or math.inf
        self._end_s = math.inf
        self.received = False
        self._handlers_before: dict[int, Handler] = {}
        self._left = False  # whether the context was left, so that signals must go to the previous handlers

    def __enter__(self) -> Self:
        self._left = False
        is_main = threading.current_thread() is threading.main_thread()  # no other thread can set a handler
        self._handlers_before = known_handlers(heeded()) if is_main else {}
        _set(self._note, self._handlers_before)
        if _stopped:
            self._note(0, None)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._left = True
        for number, handler in self._handlers_before.items():
            signal.signal(number, handler)

    def at_most(self, seconds: float) -> float:
        """How long to wait for something: `seconds`, or less if the grace time ends sooner."""
        return max(0.0, min(seconds, self._end_s - monotonic()))

    def time_is_up(self, save_s: float) -> bool:
        """Whether the current update must be abandoned. `save_s` is the longest time that a checkpoint has taken so far."""
        for_saving_s = max(FOR_SAVING * self._grace_s, SAVE_TAKES * save_s)
        return self.received and self._end_s < math.inf and monotonic() > self._end_s - for_saving_s

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._left:
            put_back_late(number, self._handlers_before[number])
        elif not self.received:
            self.received = True
            self._end_s = monotonic() + self._grace_s
            for each, handler in self._handlers_before.items():
                if each == signal.SIGINT or math.isinf(self._grace_s):
                    signal.signal(each, handler)  # a second signal goes to the previous handler
