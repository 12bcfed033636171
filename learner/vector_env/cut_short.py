"""Knows whether a call was cut short, as by Ctrl-C. Pure.

Rule: an interrupt may come between any two instructions, so nobody knows what a call that was cut short has done. Only a
reset of all copies is possible then, because it depends on nothing that came before. So no loss is hidden, and no row is
dropped unnoticed, whatever the interrupt has left half done.
"""

from __future__ import annotations

from types import TracebackType

from millrace.protocol.errors import UsageError


class CutShort:
    """The context of each call. An `Exception` ends a call; any other exception, such as `KeyboardInterrupt`, cuts it short.

    The newest call was cut short if this is true and no call is under way. A call that ends with an `Exception` doesn't
    change that, because a reset that failed may have sent nothing.
    """

    def __init__(self) -> None:
        self._began = False  # set before a call does anything, and cleared after it has done everything
        self._before = False

    def __bool__(self) -> bool:
        return self._began

    def check(self, doing: str) -> None:
        """Raise `UsageError` if the newest call was cut short."""
        if self._began:
            raise UsageError(f"{doing} after an interrupted call: reset all copies first, with reset()")

    def __enter__(self) -> None:
        self._before = self._began
        self._began = True

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None) -> None:
        if kind is None:
            self._began = False
        elif issubclass(kind, Exception):
            self._began = self._before
