"""If an update fails, rolls a replay buffer back to the state before the update, without a copy of the whole buffer.

Rule: once a state is remembered, the buffer saves the content of each slot before it writes to the slot. Rolling back writes
the saved contents back in reverse order, so the oldest content of a slot is written last.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from millrace.learner.algorithms.replay.priorities import Priorities
from millrace.protocol.arrays import Ints

KeptT = TypeVar("KeptT")


class Remembered(NamedTuple):
    """The state that `roll_back` returns a replay buffer to, without the content of the slots."""

    written: int
    rows: int
    highest: float
    newest: dict[int, Ints]
    generator: Any


class Rewinding(ABC, Generic[KeptT]):
    """A replay buffer that can roll back. `KeptT` is the type of the saved slot contents."""

    generator: np.random.Generator
    _written: int
    _rows: int
    _priorities: Priorities | None
    """None if the buffer draws uniformly"""
    _newest: dict[int, Ints]
    _remembered: Remembered | None
    _overwritten: list[KeptT]
    """the contents saved since `remember`, oldest first"""

    @property
    def _highest(self) -> float:
        """The highest priority so far; 1 without priorities."""
        return 1.0 if self._priorities is None else self._priorities.highest

    def remember(self) -> None:
        """Remember the current state, for `roll_back`. From then on, slots are saved before they are written."""
        self._overwritten.clear()
        self._remembered = Remembered(
            self._written, self._rows, self._highest, dict(self._newest), self.generator.bit_generator.state
        )

    def roll_back(self) -> None:
        """Return to the state of the last `remember`."""
        remembered = self._remembered
        assert remembered is not None, "nothing was remembered"
        self._written = remembered.written
        self._rows = remembered.rows
        if self._priorities is not None:
            self._priorities.highest = remembered.highest
        self._newest = dict(remembered.newest)
        self.generator.bit_generator.state = remembered.generator
        for old in reversed(self._overwritten):
            self._put_back(old)
        self._overwritten.clear()

    @abstractmethod
    def _put_back(self, old: KeptT) -> None:
        """Write the saved contents of some slots back."""
