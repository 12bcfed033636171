"""Checks arrays from elsewhere: their shapes and dtypes, and that values are finite and in their space. Pure.

Each check returns a one-line error, or an empty string if nothing is wrong. The line names the first wrong value and its
place. `axes` names the leading dimensions of an array: with ("step", "copy"), the place is "at step 3, copy 1". If each copy
has a column for each of its seats, the names of the seats stand in place of "copy": with ("step", ("black", "white")), the
place is "at step 3, copy 1, white".
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.specs import ActionSpec, Leaf

Axes = Sequence[str | tuple[str, ...]]
STEP_AND_COPY: Axes = ("step", "copy")


class Expected(NamedTuple):
    """An array, and its expected shape, dtype and space."""

    name: str
    array: Array
    shape: tuple[int, ...]
    dtype: str
    space: Leaf | ActionSpec | None = None
    """If None, the values may be any finite numbers. The values of an action are as stored: choices count from 0."""


def wrong_arrays(expected: Iterable[Expected], axes: Axes | None = STEP_AND_COPY) -> str:
    """What is wrong with the first invalid array; empty if all are valid. If `axes` is None, values aren't checked."""
    for each in expected:
        array = each.array
        if why := _misfit(array, each.shape, each.dtype) or (axes is not None and wrong_values(array, each.space, axes)):
            return f"{each.name}: {why}"
    return ""


def wrong_observation(
    arrays: Sequence[Array], leaves: Sequence[Leaf], rows: tuple[int, ...], axes: Axes | None = STEP_AND_COPY
) -> str:
    """What is wrong with an observation's arrays, one [*rows, *leaf] for each leaf; empty if nothing is."""
    if len(arrays) != len(leaves):
        return f"observation: expected {len(leaves)} arrays, got {len(arrays)}"
    each = zip(leaves, arrays, strict=True)
    return wrong_arrays((Expected(leaf.name, array, (*rows, *leaf.shape), leaf.dtype, leaf) for leaf, array in each), axes)


def wrong_values(array: Array, space: Leaf | ActionSpec | None = None, axes: Axes = STEP_AND_COPY, first: int = 0) -> str:
    """What is wrong with values [..., *shape]: a value is not finite, or is not in its `space`.

    The bounds of a Box are not checked, because many environments exceed theirs. `first` is the number of row 0 in errors.
    """
    # `count_nonzero` takes a third of the time that `all` or `any` takes.
    if array.dtype.kind == "f" and np.count_nonzero(finite := np.isfinite(array)) != array.size:
        return f"expected finite values, got {_first(array, ~finite, axes, first)}"
    if space is None or space.kind == "box" or array.dtype.kind == "b":
        return ""
    if space.kind == "mixed":
        sizes = np.array((*space.sizes, *[2] * space.bits), np.int64)
        array = array[..., : len(sizes)]  # leaves out the numbers of Box parts, which come last
    else:
        sizes = np.reshape(space.sizes, space.shape) if space.sizes else np.full(space.shape, 2)  # 2: MultiBinary
    start = np.reshape(space.start, space.shape) if space.start and isinstance(space, Leaf) else np.zeros_like(sizes)
    counts = array - start
    wrong = (counts < 0) | (counts >= sizes)
    if array.dtype.kind == "f":
        wrong |= counts != np.trunc(counts)
    if not np.count_nonzero(wrong):
        return ""
    low, count = (np.broadcast_to(of_entry, array.shape)[wrong][0] for of_entry in (start, sizes))
    return f"expected {low} to {low + count - 1}, got {_first(array, wrong, axes, first)}"


def _misfit(array: Array, shape: tuple[int, ...], dtype: str) -> str:
    """What is wrong with the shape or dtype of an array, or with its bytes if it is bool: they must be 0 or 1."""
    if array.shape != shape or array.dtype != np.dtype(dtype):
        got = f"{array.dtype}{list(array.shape)}"
        return f"expected {dtype}{list(shape)}, got {got}; is its environment the same version?"
    if array.dtype.kind == "b" and array.size and (largest := array.view(np.uint8).max()) > 1:
        return f"expected bytes 0 and 1, got {largest}"
    return ""


def _first(array: Array, wrong: Bools, axes: Axes, first: int) -> str:
    """The first wrong value and its place."""
    index = np.argwhere(wrong)[0]
    value = array[tuple(index)]
    index[:1] = index[:1] + first
    return f"{value} at {place}" if (place := place_of(index, axes)) else f"{value}"


def place_of(index: Iterable[int], axes: Axes) -> str:
    """The position of an entry of an array, in words; see the top of this file."""
    words = []
    for axis, number in zip(axes, index, strict=False):
        copy, seat = (number, None) if isinstance(axis, str) else divmod(number, len(axis))
        words.append(f"{axis} {copy}" if seat is None else f"copy {copy}, {axis[seat]}")
    return ", ".join(words)
