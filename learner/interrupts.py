"""SIGINT, SIGTERM and SIGHUP of a learner: the first ends the run, within the grace time if there is one.

Rule: the first signal lets the current update end; `time_is_up` says when it must be given up, so that the rest of the
grace time is enough to save. A second SIGINT (Ctrl-C) ends the run at once. If there is a grace time, SIGTERM and SIGHUP may
come again and change nothing: they often go to a process and to its group, and the time is limited already. SIGHUP says that
the terminal is gone. A learner that was told to ignore it (`nohup`) continues to ignore it.

Rule: where there is nothing to save, a signal ends the program too, with the same exit code (`stopped_by_signals`).
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from time import monotonic
from types import FrameType, TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
FOR_SAVING = 0.5  # the part of the grace time that an update must leave
SAVE_TAKES = 1.5  # factor: saving takes at most this times the longest so far

_stopped = False  # whether `Stopped` was raised: other code, such as an import or a finalizer, may have swallowed it
Handler = Callable[[int, FrameType | None], None] | signal.Handlers


class Stopped(KeyboardInterrupt):
    """A signal has stopped the program.

    It is a separate class, because after a plain KeyboardInterrupt has passed through `exec`, for example in the definition
    of a dataclass, Python ends as if the signal had killed it, whatever the program does with the exception.
    """


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """While it is entered, the first signal raises `Stopped`.

    Later ones are ignored, because they would only cut the clean-up short. Blocked signals are delivered on entry. After the
    exit, signals are ignored: at its end, Python would remove any other handler.
    """
    global _stopped

    def stop(number: int, frame: FrameType | None) -> None:
        global _stopped
        if not _stopped:
            _stopped = True
            raise Stopped

    _set(stop)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        yield
    finally:
        _set(signal.SIG_IGN)
        _stopped = False


def _set(handler: Handler) -> dict[int, Any]:
    """Set the handler of the signals that are not ignored. Returns those before."""
    heeded = [each for each in SIGNALS if each != signal.SIGHUP or signal.getsignal(each) != signal.SIG_IGN]
    return {each: signal.signal(each, handler) for each in heeded}


class Interrupts:
    """Counts signals while it is entered, and restores the handlers afterwards. Does nothing outside the main thread."""

    def __init__(self, grace_s: float = 0.0) -> None:
        """`grace_s`: seconds from the first signal to the end of the process; 0: any number."""
        self._grace_s = grace_s or math.inf
        self._end_s = math.inf
        self.received = False
        self._handlers_before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        with suppress(ValueError):  # not in the main thread, which handles signals itself
            self._handlers_before = _set(self._note)
        if _stopped:
            self._note(0, None)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._handlers_before.items():
            signal.signal(number, handler)

    def at_most(self, seconds: float) -> float:
        """These seconds, or fewer if the grace time ends before: how long to wait for something."""
        return max(0.0, min(seconds, self._end_s - monotonic()))

    def time_is_up(self, save_s: float) -> bool:
        """Whether the current update must be given up. `save_s`: how long the longest checkpoint took."""
        for_saving_s = max(FOR_SAVING * self._grace_s, SAVE_TAKES * save_s)
        return self.received and self._end_s < math.inf and monotonic() > self._end_s - for_saving_s

    def _note(self, number: int, frame: FrameType | None) -> None:
        if not self.received:
            self.received = True
            self._end_s = monotonic() + self._grace_s
            for each, handler in self._handlers_before.items():
                if each == signal.SIGINT or math.isinf(self._grace_s):
                    signal.signal(each, handler)  # a second one has its effect without this class
