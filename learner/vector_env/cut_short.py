"""Knows whether a call was cut short, as by Ctrl-C. Pure.

Rule: an interrupt may come between any two instructions, so nobody knows what a call that was cut short has done. Only a
reset of all copies is possible then, because it depends on nothing that came before. So no loss is hidden, and no row is
dropped unnoticed, whatever the interrupt has left half done.
"""

from __future__ import annotations

from types import TracebackType


class CutShort:
    """The context of each call. An `Exception` ends a call; any other exception, such as `KeyboardInterrupt`, cuts it short.

    The newest call was cut short if this is true and no call is under way.
    """

    def __init__(self) -> None:
        self._began = False  # set before a call does anything, and cleared after it has done everything

    def __bool__(self) -> bool:
        return self._began

    def __enter__(self) -> None:
        self._began = True

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None) -> None:
        if kind is None or issubclass(kind, Exception):
            self._began = False
