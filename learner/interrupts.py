"""SIGINT, SIGTERM and SIGHUP of a learner: the first ends the run, within the grace time if there is one.

Rule: the first signal lets the current update end; `time_is_up` says when it must be given up, so that the rest of the
grace time is enough to save. A second SIGINT (Ctrl-C) ends the run at once. If there is a grace time, SIGTERM and SIGHUP may
come again and change nothing: they often go to a process and to its group, and the time is limited already. SIGHUP says that
the terminal is gone. A learner that was told to ignore it (`nohup`) goes on ignoring it.
"""

from __future__ import annotations

import math
import signal
from time import monotonic
from types import FrameType, TracebackType
from typing import Any, Self

FOR_SAVING = 0.5  # the part of the grace time that an update must leave
SAVE_TAKES = 1.5  # times as long as the longest so far, at most


class Interrupts:
    """Counts signals while it is entered, and restores the handlers afterwards. Does nothing outside the main thread."""

    def __init__(self, grace_s: float = 0.0) -> None:
        """`grace_s`: seconds from the first signal to the end of the process; 0: any number."""
        self._grace_s = grace_s or math.inf
        self._end_s = math.inf
        self.received = False
        self._handlers_before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        try:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                    self._handlers_before[number] = signal.signal(number, self._note)
        except ValueError:  # not in the main thread, which handles signals itself
            self._handlers_before.clear()
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
            self.received, self._end_s = True, monotonic() + self._grace_s
            for each, handler in self._handlers_before.items():
                if each == signal.SIGINT or math.isinf(self._grace_s):
                    signal.signal(each, handler)  # the second one does what it would have done without us
