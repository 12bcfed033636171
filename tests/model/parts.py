"""The parts that states of the model are made of, each with a number: learners, workers, messages, and seats.

Rule: a part is met once and kept. Equal parts have one number, so that states are compared by a few small numbers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from tests.model.conversation import Content
from tests.model.names import OF_WORKER, Name, names_in, renamed, renaming


class Seat(NamedTuple):
    """A worker, and the messages that are on their way, oldest first; all by the number of the part."""

    worker: int
    up: tuple[int, ...] = ()
    down: tuple[int, ...] = ()
    late_up: tuple[int, ...] = ()
    """copies of messages that have arrived; they can arrive at any time"""
    late_down: tuple[int, ...] = ()


class Parts(list[Any]):
    """All parts that were met."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[frozenset[Name]] = []
        """of each part"""
        self._numbers: dict[Any, int] = {}
        self._renamed: dict[Any, int] = {}

    def number(self, part: Content | Seat) -> int:
        """The number of this part."""
        number = self._numbers.get(part)
        if number is None:
            number = self._numbers[part] = len(self)
            self.append(part)
            if isinstance(part, Seat):
                numbers = part.worker, *part.up, *part.down, *part.late_up, *part.late_down
                self.names.append(frozenset().union(*[self.names[each] for each in numbers]))
            else:
                self.names.append(frozenset(names_in(part, set())))
        return number

    def renamed(self, number: int, new: dict[Name, Name | None]) -> int:
        """The same part under other names."""
        names = self.names[number]
        if names.isdisjoint(new):
            return number
        key = number, tuple([new.get(each, each) for each in names])
        found = self._renamed.get(key)
        if found is None:
            found = self._renamed[key] = self.number(self._compute_renamed(self[number], new))
        return found

    def alone(self, seat: int) -> tuple[int, tuple[Name, ...]]:
        """The same seat of worker 0, under names that do not depend on the other parts of the state; and its old names.

        The old names are without those of the worker, which depend on its number.
        """
        names = self.names[seat]
        own = {each.scope: 0 for each in names if each.kind in OF_WORKER}
        others = sorted(each for each in names if each.kind not in OF_WORKER)
        return self.renamed(seat, renaming(names, own)), tuple(others)

    def _compute_renamed(self, part: Content | Seat, new: dict[Name, Name | None]) -> Any:
        if not isinstance(part, Seat):
            return renamed(part, new)
        up, down, late_up, late_down = (tuple([self.renamed(each, new) for each in messages]) for messages in part[1:])
        return Seat(self.renamed(part.worker, new), up, down, tuple(sorted(late_up)), tuple(sorted(late_down)))
