"""The storage of a replay buffer: a ring of slots in preallocated arrays, which is saved, and rolled back after failures.

Rule: once a state is remembered, the content of each slot is saved before the slot is written. Rolling back writes the saved
contents back in reverse order, so the oldest content of a slot is written last. It needs no copy of the whole ring.

A subclass decides what a slot holds, writes it and draws from it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Container, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from millrace.learner.algorithms.replay.priorities import Priorities
from millrace.learner.algorithms.replay.shared_channels import SharedChannels
from millrace.learner.algorithms.replay.sum_tree import SumTree
from millrace.protocol.arrays import Array, Bools, Doubles, Ints
from millrace.protocol.errors import UsageError
from millrace.protocol.machine.available_memory import GIB, available_bytes
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.specs import Leaf


class Remembered(NamedTuple):
    """The state that `roll_back` returns a ring to, without the content of the slots."""

    written: int
    rows: int
    highest: float
    newest: dict[int, Ints]
    generator: Any


class Overwritten(NamedTuple):
    """The contents of some slots before they were written."""

    slots: Ints  # [K]
    arrays: dict[str, Array]  # [K, …] each, by name; only of the arrays that were written
    weights: Doubles | None  # [K] their weights in the sum tree; None without priorities


class Ring(ABC):
    """Slots that hold rows. The oldest slot is overwritten first."""

    _purpose = Purpose.REPLAY

    def __init__(
        self,
        size: int,
        shapes: Mapping[str, tuple[tuple[int, ...], Any]],
        *,
        seed: int,
        alpha: float | None,
        images: Mapping[str, Leaf] | None = None,
        steps: int = 1,
        other_bytes: int = 0,
    ) -> None:
        """Allocate `size` slots of up to `steps` rows. If `alpha` is None, they have no priorities.

        `shapes` has the shape and dtype of each slot's arrays, by name. `images` are those of them that hold an image.
        `other_bytes` is the memory that the subclass needs besides. Raises `UsageError` if there is too little memory.
        """
        self.size = size  # number of slots
        self._images = images or {}
        self._steps = steps  # the most rows of a slot
        self._other_bytes = other_bytes + (0 if alpha is None else SumTree.memory_bytes(size))
        slot_bytes = sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())
        self._check_memory(size * slot_bytes + self._other_bytes)
        self.arrays: dict[str, Array] = {name: np.zeros((size, *shape), dtype) for name, (shape, dtype) in shapes.items()}
        """[size, …] each, by name; without those in `shared`"""
        self.shared: dict[str, SharedChannels] = {}
        """the arrays of images that store equal channels once, by name"""
        self.generator = generator(seed, self._purpose)  # the source of random numbers for all samples
        self._priorities = None if alpha is None else Priorities(size, alpha)
        self._written = 0  # number of slots ever written; modulo the size, it is the next slot
        self._rows = 0
        self._newest: dict[int, Ints] = {}
        """by lane, [columns] the value of `_written` when the newest slot of each column was written"""
        self._remembered: Remembered | None = None
        self._overwritten: list[Overwritten] = []  # contents saved since `remember`, oldest first

    def __len__(self) -> int:
        """The number of rows that can be drawn."""
        return self._rows

    @property
    def bytes(self) -> int:
        """Memory of all slots, in bytes."""
        return sum(array.nbytes for array in self._all_arrays().values()) + self._other_bytes

    @property
    def prioritized(self) -> bool:
        """Whether slots are drawn by priority."""
        return self._priorities is not None

    @property
    @abstractmethod
    def _is_row(self) -> Bools:
        """[size, …] True where a slot holds a row. A view."""

    @property
    def _used(self) -> int:
        """The number of slots in use. They are the first ones."""
        return min(self._written, self.size)

    @property
    def _highest(self) -> float:
        """The highest priority so far; 1 without priorities."""
        return 1.0 if self._priorities is None else self._priorities.highest

    def _all_arrays(self) -> dict[str, Array | SharedChannels]:
        return self.arrays | self.shared

    # ---------------------------------------------------------------- memory

    def _check_memory(self, needed: int) -> None:
        """Raise `UsageError` if there isn't enough memory for the ring and a copy of it. The error names a size that fits.

        Writing a checkpoint needs such a copy. `needed` is the size of the ring in bytes.
        """
        free = available_bytes()
        if free is None or 2 * needed <= free:
            return
        rows = self.size * self._steps
        fits = rows * free // (2 * needed)
        fits -= fits % 10 ** max(0, len(str(fits)) - 2)
        raise UsageError(
            f"replay_size {rows}: {rows} transitions take {needed / GIB:.1f} GiB, and as much again while a checkpoint is "
            f"written, but {free / GIB:.1f} GiB of memory are free; take --replay-size {fits} or less"
        )

    def _make_masks(self, shape: tuple[int, ...]) -> None:
        """Allocate the action masks of each slot when the first masks arrive. Raises `UsageError` if there is no memory."""
        if "mask" not in self.arrays:
            self._check_memory(self.bytes + self.size * math.prod(shape))
            self.arrays["mask"] = np.ones((self.size, *shape), bool)

    def _share(self, names: Container[str]) -> None:
        """Allocate the arrays of images again. Those with these names then store equal channels once."""
        for name, leaf in self._images.items():
            self.arrays.pop(name, None)
            self.shared.pop(name, None)
            if name in names:
                self.shared[name] = SharedChannels(self.size, leaf)
            else:
                self.arrays[name] = np.zeros((self.size, *leaf.shape), leaf.dtype)

    # ---------------------------------------------------------------- rolling back

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
        self._newest = dict(remembered.newest)
        self.generator.bit_generator.state = remembered.generator
        arrays = self._all_arrays()
        for old in reversed(self._overwritten):
            for name, before in old.arrays.items():
                arrays[name][old.slots] = before
            if self._priorities is not None and old.weights is not None:
                self._priorities.tree.set(old.slots, old.weights)
        if self._priorities is not None:
            self._priorities.highest = remembered.highest
        self._overwritten.clear()

    def _keep(self, slots: Ints, names: Sequence[str] | None = None) -> None:
        """If `remember` was called, save these slots before they are written: their priorities, and these arrays or all."""
        if self._remembered is not None and len(slots):
            arrays = self._all_arrays()
            saved = {name: arrays[name][slots] for name in (arrays if names is None else names)}
            weights = None if self._priorities is None else self._priorities.tree.weights[slots]
            self._overwritten.append(Overwritten(slots, saved, weights))

    # ---------------------------------------------------------------- saving

    def _saved_arrays(self) -> dict[str, Array]:
        """The arrays of a saved state, by name. An array of records is saved as one array for each field."""
        saved: dict[str, Array] = {}
        for name, array in self.arrays.items():
            fields = array.dtype.names
            saved |= {name: array} if fields is None else {field: array[field] for field in fields}
        return saved

    def state_dict(self) -> dict[str, Any]:
        """A copy of the slots in use, as tensors and plain data."""
        used = self._used
        weights = {} if self._priorities is None else {"weight": self._priorities.tree.weights}
        return {
            "size": self.size,
            "arrays": {name: torch.tensor(array[:used]) for name, array in (self._saved_arrays() | weights).items()},
            "shared": {name: list(map(torch.from_numpy, images.saved(used))) for name, images in self.shared.items()},
            "newest": {lane: torch.tensor(written) for lane, written in self._newest.items()},
            "written": self._written,
            "highest": self._highest,
            "generator": self.generator.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`, bit for bit. Raises ValueError if its size differs from this ring's."""
        if state["size"] != self.size:
            had, has = (size * self._steps for size in (state["size"], self.size))
            raise ValueError(f"replay_size: expected {had}, got {has}")
        self._written = state["written"]
        self._newest = {int(lane): written.numpy().copy() for lane, written in state["newest"].items()}
        self.generator.bit_generator.state = state["generator"]
        arrays = state["arrays"]
        used = self._used
        if "mask" in arrays:
            self._make_masks(arrays["mask"].shape[1:])
        shared = state.get("shared", {})
        self._share(shared)
        for name, images in self.shared.items():
            images.load(*(tensor.numpy() for tensor in shared[name]))
        for name, array in self._saved_arrays().items():
            array[:used] = arrays[name].numpy()
        if self._priorities is not None:
            self._priorities.load(arrays["weight"].numpy(), state["highest"])
        self._is_row[used:] = False
        self._rows = int(np.count_nonzero(self._is_row))
