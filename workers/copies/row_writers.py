"""Writes what N env copies returned into arrays, and refuses values that an array would silently change (`CopyFailed`).

numpy's assignment broadcasts an observation of another shape, reads None as NaN and text as a number, and truncates
fractions in a space of integers. Here, every observation must have the shape of its space. Its dtype may be cast only within
the same kind, and integers must keep their values. This is checked at every step, by calls that handle all copies at once;
the loop over the copies runs only to find out which of them is wrong. Rewards and flags are converted by numpy's assignment:
None becomes NaN, which is refused when the values of the rollout are checked.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NoReturn

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import first_line, safe_repr
from millrace.protocol.specs import Leaf
from millrace.workers.copies.env_errors import CopyFailed

Numbers = tuple[Any, Any, Any]
"""Reward, terminated and truncated of N copies, each as an array or a sequence."""


class LeafWriter:
    """Writes one array of the observations of N copies."""

    def __init__(self, leaf: Leaf, copies: int) -> None:
        self._leaf = leaf
        self._dtype = np.dtype(leaf.dtype)
        self._is_whole = self._dtype.kind in "iu"
        self._shape = (copies, *leaf.shape)
        # The fastest way to write observations with at least one dimension is to join them along the first.
        self._lengths = [leaf.shape[0]] * copies if leaf.shape else None
        self._joined_shape = (copies * leaf.shape[0], *leaf.shape[1:]) if leaf.shape else (copies,)
        # "same_kind" is the default, and passing it explicitly would add about a tenth to the time of the call.
        self._join: Callable[..., Any] = partial(np.concatenate, casting="safe") if self._is_whole else np.concatenate

    def joined(self, array: Array) -> Array:
        """A view of a contiguous array [*rows, N, *leaf], with the N observations joined along their first dimension."""
        return array.reshape(array.shape[: array.ndim - len(self._shape)] + self._joined_shape)

    def write(self, joined: Array, values: Any) -> None:
        """Write `values`, an array [N, *leaf] or N observations in order, into one row of a `joined` array.

        Raises `CopyFailed` for an observation that doesn't fit; some of the others may have been written by then.
        """
        try:
            if self._lengths is not None and isinstance(values, (list, tuple)):
                if list(map(len, values)) == self._lengths:
                    self._join(values, out=joined)
                    return
            else:
                array = np.asarray(values)
                if array.shape == self._shape and (array.dtype == self._dtype or self._keeps_values(array)):
                    joined[...] = array.reshape(self._joined_shape)
                    return
        except Exception:  # user-defined objects may raise anything; the loop below finds what is wrong, if anything is
            pass
        row = joined.reshape(self._shape)
        if len(values) != len(row):
            raise CopyFailed(None, line=f"{self._leaf.name}: expected observations of {len(row)} copies, got {len(values)}")
        for n, value in enumerate(values):
            self.write_one(row, n, value)

    def write_one(self, row: Array, n: int, value: Any) -> None:
        """Write the observation of copy `n` into `row` [N, *leaf]. Raises `CopyFailed` if it doesn't fit."""
        try:
            array = np.asarray(value)
        except ValueError:  # nested lists of different lengths
            array = np.asarray(None)
        except Exception as error:  # for example, for a PyTorch tensor that requires a gradient
            got = f"a {type(value).__name__} that numpy cannot read: {first_line(error)}"
            raise CopyFailed(n, line=f"{self._leaf.name}: expected an array, got {got}") from error
        if array.shape != self._leaf.shape or not self._keeps_values(array):
            self._refuse(n, array)
        row[n] = array

    def _keeps_values(self, array: Array) -> bool:
        """Whether a cast to the leaf's dtype keeps the kind of number, and the value of each integer."""
        if array.dtype == self._dtype:
            return True
        if self._is_whole:
            return array.dtype.kind in "biu" and bool((array.astype(self._dtype) == array).all())
        return np.can_cast(array.dtype, self._dtype, "same_kind")

    def _refuse(self, n: int, array: Array) -> NoReturn:
        expected = f"expected {self._dtype}{list(self._leaf.shape)} as its space says"
        got = f"got {array.dtype}{list(array.shape)}"
        if self._is_whole and array.shape == self._leaf.shape and array.dtype.kind in "iu":
            got += f" with the value {array[array.astype(self._dtype) != array].flat[0]}"
        raise CopyFailed(n, line=f"{self._leaf.name}: {expected}, {got}; fix the environment or its observation_space")


class ObservationWriter:
    """Writes the observations of N columns, which have these leaves. Each method raises `CopyFailed` for a value that
    doesn't fit.
    """

    def __init__(self, leaves: Iterable[Leaf], columns: int, seats: Sequence[str] = ()) -> None:
        """`seats` are the names of a copy's seats, for errors. If there are none, each column is a copy."""
        self._writers = [LeafWriter(leaf, columns) for leaf in leaves]
        self._seats = seats

    def joined(self, arrays: Iterable[Array]) -> list[Array]:
        """Views of arrays [*rows, N, *leaf] for `write`."""
        return [writer.joined(array) for writer, array in zip(self._writers, arrays, strict=True)]

    def write(self, joined: Iterable[Array], t: int, leaves: Iterable[Any]) -> None:
        """Write the observations of all copies into row `t` of `joined` arrays."""
        for writer, array, values in zip(self._writers, joined, leaves, strict=True):
            try:
                writer.write(array[t], values)
            except CopyFailed as error:
                raise of_seat(error, self._seats) from error

    def write_some(self, arrays: Iterable[Array], columns: Sequence[int], leaves: Iterable[Any]) -> None:
        """Write the observations of these columns into arrays [N, *leaf]. The values in `leaves` are indexed by column."""
        for writer, array, values in zip(self._writers, arrays, leaves, strict=True):
            for n in columns:
                try:
                    writer.write_one(array, n, values[n])
                except CopyFailed as error:
                    raise of_seat(error, self._seats) from error


def of_seat(error: CopyFailed, seats: Sequence[str]) -> CopyFailed:
    """Convert an error that names a column to one that names the copy and the seat. Without seats, return it unchanged."""
    if not seats or error.copy is None:
        return error
    copy, seat = divmod(error.copy, len(seats))
    return CopyFailed(copy, error.doing, f"{seats[seat]}, {error.line}")


def read_leaves(
    read: Callable[[Any], tuple[Any, ...]], observations: Sequence[Any], seats: Sequence[str] = ()
) -> tuple[Sequence[Any], ...]:
    """Split the Dict or Tuple observations of N columns into leaves: for each leaf, returns its N values.

    Raises `CopyFailed` if a leaf is missing.
    """
    try:
        return tuple(zip(*map(read, observations), strict=True))
    except (LookupError, TypeError):
        for n, observation in enumerate(observations):
            try:
                read(observation)
            except (LookupError, TypeError) as error:
                raise of_seat(missing_leaf(n, observation, error), seats) from error
        raise


def missing_leaf(n: int | None, observation: Any, error: Exception) -> CopyFailed:
    """The error for an observation in which a leaf of its space cannot be found."""
    keys = f" of {', '.join(map(safe_repr, observation))}" if isinstance(observation, dict) else ""
    return CopyFailed(
        n,
        line=f"observation: expected the structure of its space, got a {type(observation).__name__}{keys} "
        f"({type(error).__name__}: {first_line(error)}); fix the environment or its observation_space",
    )


def write_numbers(arrays: Numbers, row: int | slice, values: Numbers) -> None:
    """Write reward, terminated and truncated of N copies into this row of three arrays: `array[row]` has the shape [N].

    As in gymnasium, an array with one element counts as a number. Raises `CopyFailed`, which names the copy, for anything
    else that isn't a number.
    """
    reward, terminated, truncated = arrays
    try:
        reward[row], terminated[row], truncated[row] = values
    except Exception:  # user-defined objects may raise anything, and an int may be too large; the loop finds what is wrong
        for name, array, of_copies in zip(("reward", "terminated", "truncated"), arrays, values, strict=True):
            for n, value in enumerate(of_copies):
                array[row][n] = one_number(name, n, value)


def one_number(name: str, n: int, value: Any) -> Any:
    """The reward, terminated or truncated (`name`) that copy `n` returned, as a number.

    Raises `CopyFailed` if it isn't one; for a vector of rewards, the error gives advice.
    """
    try:
        array = np.asarray(value)
    except Exception:  # nested lists of different lengths, or a user-defined object
        array = np.asarray(None)
    if array.size == 1 and array.dtype.kind in "biuf":
        return array.item()
    if array.size == 1:
        raise CopyFailed(n, line=f"{name}: expected a number, got {one_line(safe_repr(value), 80)}")
    advice = "; wrap the environment so that it returns one number" if name == "reward" else ""
    if advice and "mo_gymnasium" in sys.modules:
        advice += ", as --wrappers mo_gymnasium.wrappers:LinearReward does"
    raise CopyFailed(n, line=f"{name}: expected a number, got an array of shape {array.shape}{advice}")
