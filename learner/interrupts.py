"""SIGINT, SIGTERM and SIGHUP of a learner: the first ends the run after the current update, the second ends it at once.

SIGHUP says that the terminal is gone. A learner that was told to ignore it (`nohup`) goes on ignoring it.
"""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any, Self


class Interrupts:
    """Counts signals while it is entered, and restores the handlers afterwards. Does nothing outside the main thread."""

    def __init__(self) -> None:
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
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = True
        self._restore()  # the second signal does what it would have done without us

    def _restore(self) -> None:
        for number, handler in self._handlers_before.items():
            signal.signal(number, handler)
