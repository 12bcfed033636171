"""Makes gymnasium spaces from the JSON in which Minari stores them. Pure.

Rule: as in `millrace.protocol.space_spec`, sizes are checked before memory of that size is allocated.
"""

from __future__ import annotations

import json
from typing import Any

import gymnasium
import msgspec
import numpy as np

from millrace.protocol.bounds import Count, Natural, Whole
from millrace.protocol.envs.space_records import make_space
from millrace.protocol.space_spec import (
    BoxSpace,
    DictSpace,
    DiscreteSpace,
    Dtype,
    MultiBinarySpace,
    MultiDiscreteSpace,
    Shape,
    SpaceSpec,
    TupleSpace,
    check_space,
)


def space_of_json(name: str, text: str) -> gymnasium.Space[Any]:
    """The space that this JSON text describes. `name`: its name in errors. Raises exceptions of several types."""
    spec = _spec(msgspec.convert(json.loads(text), _Space))
    check_space(name, spec)
    return make_space(spec)


def _spec(space: _Space) -> SpaceSpec:
    match space:
        case _Box(shape, dtype, low, high):
            return BoxSpace(shape, dtype, np.array(low, dtype), np.array(high, dtype))
        case _Discrete(n, start):
            return DiscreteSpace(n, start, "int64")
        case _MultiDiscrete(dtype, nvec, start):
            return MultiDiscreteSpace(dtype, np.array(nvec, np.int64), np.array(start, np.int64))
        case _MultiBinary(n):
            return MultiBinarySpace((n,) if isinstance(n, int) else n)
        case _Dict(inside):
            return DictSpace(tuple(inside), tuple(map(_spec, inside.values())))
        case _Tuple(inside):
            return TupleSpace(tuple(map(_spec, inside)))


class _Box(msgspec.Struct, tag_field="type", tag="Box"):
    shape: Shape
    dtype: Dtype
    low: Any
    high: Any


class _Discrete(msgspec.Struct, tag_field="type", tag="Discrete"):
    n: Count
    start: Whole = 0


class _MultiDiscrete(msgspec.Struct, tag_field="type", tag="MultiDiscrete"):
    dtype: Dtype
    nvec: Any
    start: Any


class _MultiBinary(msgspec.Struct, tag_field="type", tag="MultiBinary"):
    n: Natural | Shape


class _Dict(msgspec.Struct, tag_field="type", tag="Dict"):
    subspaces: dict[str, _Space]


class _Tuple(msgspec.Struct, tag_field="type", tag="Tuple"):
    subspaces: list[_Space]


_Space = _Box | _Discrete | _MultiDiscrete | _MultiBinary | _Dict | _Tuple
