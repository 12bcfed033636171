"""A replay buffer returns to the state that it had before an update, if that update fails. No copy of the buffer is made.

Rule: once a state is remembered, a buffer keeps what a slot held before it writes the slot. Going back writes this in
reverse order, so the oldest content comes last.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from millrace.protocol.arrays import Ints

KeptT = TypeVar("KeptT")


class Remembered(NamedTuple):
    """The state of a replay buffer that `roll_back` returns to, without the slots."""

    written: int
    rows: int
    highest: float
    newest: dict[int, Ints]
    generator: Any


class Rewinding(ABC, Generic[KeptT]):
    """What remembering needs of a replay buffer; `KeptT` is what some of its slots held before they were written."""

    generator: np.random.Generator
    _written: int
    _rows: int
    _highest: float
    _newest: dict[int, Ints]
    _remembered: Remembered | None
    _overwritten: list[KeptT]
    """since `remember`, oldest first"""

    def remember(self) -> None:
        """Remember this state, for `roll_back`: from now on, what a slot held is kept before it is written."""
        self._overwritten.clear()
        self._remembered = Remembered(
            self._written, self._rows, self._highest, dict(self._newest), self.generator.bit_generator.state
        )

    def roll_back(self) -> None:
        """Return to the state that was remembered last."""
        remembered = self._remembered
        assert remembered is not None, "nothing was remembered"
        self._written = remembered.written
        self._rows = remembered.rows
        self._highest = remembered.highest
        self._newest = dict(remembered.newest)
        self.generator.bit_generator.state = remembered.generator
        for old in reversed(self._overwritten):
            self._put_back(old)
        self._overwritten.clear()

    @abstractmethod
    def _put_back(self, old: KeptT) -> None:
        """Write what some slots held."""
