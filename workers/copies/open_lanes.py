"""The lanes whose env copies are open in this process.

Rule: if a lane is to be closed while environment code runs, or while its own copies are being made, it is closed only after
that code has returned, because its copies may be in the middle of a step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar


class OpenLane(Protocol):
    """Env copies that are stepped together."""

    incarnation: int

    def close(self) -> None:
        """Close the copies. Never raises."""
        ...


L = TypeVar("L", bound=OpenLane)


class OpenLanes(dict[int, L]):
    """The open lanes, by number."""

    def __init__(self) -> None:
        super().__init__()
        self._opening: int | None = None  # number of the lane whose copies are being made; None if it was closed meanwhile
        self._to_close: list[L] = []
        self._in_use = False

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """A context in which environment code runs. Lanes that are to be closed within it stay open until its end."""
        self._in_use = True
        try:
            yield
        finally:
            self._in_use = False
            self.close(())

    def here(self, number: int, incarnation: int) -> L | None:
        """The lane with this number if it is open in this incarnation, else None."""
        lane = self.get(number)
        return lane if lane is not None and lane.incarnation == incarnation else None

    def open(self, number: int, make: Callable[[], L]) -> L:
        """Close the lane's earlier incarnation, make the lane, and return it."""
        self.close([number])
        self._opening = number
        lane = make()
        if self._opening == number:
            self[number] = lane
        else:
            self._to_close.append(lane)
        return lane

    def close(self, lanes: Iterable[int]) -> None:
        """Close these lanes if they are open: immediately or, inside `in_use`, at the end of that context."""
        for number in lanes:
            if number == self._opening:
                self._opening = None
            if (lane := self.pop(number, None)) is not None:
                self._to_close.append(lane)
        while self._to_close and not self._in_use:
            self._to_close.pop().close()

    def close_all(self) -> None:
        """Close every lane."""
        self.close(list(self))
