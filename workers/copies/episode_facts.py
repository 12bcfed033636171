"""Facts of episodes: the numbers that an environment reports in `info` at an episode's last step (`RunSpec.info_keys`).

Rule: a number that is absent or not finite is missing, and is stored as NaN, not 0. A value that isn't a number is an error
of the environment, and the error's message names the key.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import safe_repr
from millrace.workers.copies.env_errors import CopyFailed

Facts = Mapping[int, tuple[float, ...]]
"""For each env copy whose episode ended in this step, the facts of that episode."""


def facts_of_info(names: Sequence[str], info: Mapping[str, Any], copy: int | None = None) -> tuple[float, ...]:
    """The facts with these names in an info. Raises `CopyFailed`, which names the copy, for values that aren't numbers."""
    return tuple(_number(name, info.get(name, math.nan), copy) for name in names)


def facts_of_copies(names: Sequence[str], infos: Mapping[str, Any], count: int) -> Array:
    """The facts [count, names] float64 of all copies of a vector environment, read from its infos in gymnasium's form.

    Raises `CopyFailed` for values that aren't numbers, or if there isn't one value for each copy.
    """
    table = np.full((count, len(names)), np.nan)
    for k, name in enumerate(names):
        if name not in infos:
            continue
        given = np.asarray(infos[name])
        there = np.asarray(infos.get(f"_{name}", np.ones(count, bool)))
        if given.shape[:1] != (count,) or there.shape != (count,):
            raise CopyFailed(
                None, line=f"info {name}: expected a number for each of {count} copies, got {_shown(infos[name])}"
            )
        for n in np.flatnonzero(there):
            table[n, k] = _number(name, given[n], int(n))
    return table


def of_ended(table: Array, ended: Array) -> Facts:
    """For each copy whose episode has ended (`ended` [N]), its row of the table [N, names]."""
    return {int(n): tuple(table[n].tolist()) for n in np.flatnonzero(ended)}


def _number(name: str, value: Any, copy: int | None) -> float:
    try:
        array = np.asarray(value)
        if array.size == 1 and array.dtype.kind in "biuf":
            number = float(array.reshape(()))
            return number if math.isfinite(number) else math.nan
    except Exception:  # nested lists of different lengths, a number too large for a float, or a user-defined object
        pass
    if value is None:
        return math.nan
    if type(value) is int:
        return math.nan  # too large for a float
    raise CopyFailed(copy, line=f"info {name}: expected a number, got {_shown(value)}; name only numbers in info_keys")


def _shown(value: Any) -> str:
    return one_line(f"{type(value).__name__} {safe_repr(value)}", 80)
