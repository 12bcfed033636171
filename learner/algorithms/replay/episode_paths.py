"""Paths: which stored observations follow one another in an episode, so that a later one is found in constant time.

Law: the paths are a function of the stored rows, so they aren't part of a saved state: `rebuilt` computes them from the
rows. A path lists the slots of an episode's observations, oldest first. The ring overwrites the oldest slot first, so a path
loses its beginning before its end, and all observations that follow a stored row are stored.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np

from millrace.protocol.arrays import Bools, Doubles, Ints

NO_SLOT = -1
NO_PATH = -1
FEW = 64
"""The number of overwritten slots that may stay at a path's beginning, because removing each one immediately is slower."""


@dataclass
class EpisodePath:
    """The slots of one episode."""

    slots: array[int] = field(default_factory=lambda: array("q"))
    first: int = 0
    """the place of `slots[0]` in the episode; earlier slots have been forgotten"""

    @property
    def end(self) -> int:
        """The place in the episode after its newest slot."""
        return self.first + len(self.slots)


class EpisodePaths:
    """The paths of all episodes in a ring of `size` slots."""

    def __init__(self, size: int) -> None:
        self._number: Ints = np.full(size, NO_PATH)  # [size] the number of the path that each slot belongs to
        self._place: Ints = np.zeros(size, np.int64)  # [size] the place of each slot on its path
        self._paths: dict[int, EpisodePath] = {}
        self._next = 0

    @staticmethod
    def memory_bytes(size: int) -> int:
        """Memory that the paths need in a ring of `size` slots, in bytes, without the spare capacity of growing arrays."""
        return 3 * size * np.dtype(np.int64).itemsize

    def overwrite(self, slots: Ints) -> None:
        """Forget these slots [K], which must be the oldest slots, oldest first."""
        for number, place in zip(self._number[slots].tolist(), self._place[slots].tolist(), strict=True):
            if number == NO_PATH:
                continue
            path = self._paths[number]
            gone = place + 1 - path.first
            if gone == len(path.slots):
                del self._paths[number]
            elif gone > FEW and 2 * gone > len(path.slots):
                del path.slots[:gone]
                path.first += gone
        self._number[slots] = NO_PATH

    def append(self, slots: Ints, after: Ints) -> None:
        """Append each of the slots [K] to the path whose newest slot is `after` [K]; NO_SLOT stands for a new path."""
        for slot, before in zip(slots.tolist(), after.tolist(), strict=True):
            if before == NO_SLOT:
                number = self._next
                self._next += 1
                self._paths[number] = EpisodePath()
            else:
                number = int(self._number[before])
            path = self._paths[number]
            self._number[slot] = number
            self._place[slot] = path.end
            path.slots.append(slot)

    def later(self, slots: Ints, chance: Doubles) -> Ints:
        """For each of the slots [K], one of the slots that follow it on its path.

        `chance` [K], in [0, 1), selects which one. If `chance` is uniform, so is the choice.
        """
        found = np.empty(len(slots), np.int64)
        wanted = zip(self._number[slots].tolist(), self._place[slots].tolist(), chance.tolist(), strict=True)
        for i, (number, place, part) in enumerate(wanted):
            path = self._paths[number]
            steps = 1 + int(part * (path.end - 1 - place))
            found[i] = path.slots[place - path.first + steps]
        return found

    @classmethod
    def rebuilt(cls, size: int, by_age: Ints, is_row: Bools, follows: Ints) -> EpisodePaths:
        """The paths of stored rows. `by_age` [K] are the slots in use, oldest first.

        `is_row` [size] says which slots hold a row, and `follows` [size] is the slot of that row's next observation.
        """
        paths = cls(size)
        leads = is_row.tolist()
        follow = follows.tolist()
        for begin in by_age.tolist():
            if paths._number[begin] != NO_PATH:
                continue
            at = begin
            slots = [at]
            while leads[at]:
                at = follow[at]
                slots.append(at)
            after = [NO_SLOT, *slots[:-1]]
            paths.append(np.array(slots), np.array(after))
        return paths
