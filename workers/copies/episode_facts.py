"""Facts of episodes: the numbers that an environment reports in `info` at an episode's last step (`RunSpec.facts`).

Rule: a number that is absent, or not finite, is missing: it is NaN, not 0. Anything that isn't a number is an error of the
environment that names the key.
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
"""By env copy: the facts of the episode that ended in this step."""


def facts_of_info(names: Sequence[str], info: Mapping[str, Any], copy: int | None = None) -> tuple[float, ...]:
    """A number for each name. Raises `CopyFailed` for values that aren't numbers."""
    return tuple(_number(name, info.get(name, math.nan), copy) for name in names)


def facts_of_copies(names: Sequence[str], infos: Mapping[str, Any], count: int) -> Array:
    """The facts [count, names] float64 of each copy of a vector environment, from its infos in gymnasium's form."""
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
    """The rows of a table [N, names] for the copies that `ended` [N]."""
    return {int(n): tuple(table[n].tolist()) for n in np.flatnonzero(ended)}


def _number(name: str, value: Any, copy: int | None) -> float:
    try:
        array = np.asarray(value)
        if array.size == 1 and array.dtype.kind in "biuf":
            number = float(array.reshape(()))
            return number if math.isfinite(number) else math.nan
    except Exception:  # rows of different lengths, a number too large for a float, a user-defined object
        pass
    if value is None:
        return math.nan
    if type(value) is int:
        return math.nan  # too large for a float
    raise CopyFailed(copy, line=f"info {name}: expected a number, got {_shown(value)}; name only numbers in info_keys")


def _shown(value: Any) -> str:
    return one_line(f"{type(value).__name__} {safe_repr(value)}", 80)
