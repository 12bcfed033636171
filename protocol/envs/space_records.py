"""Converts gymnasium spaces to plain records and back, with exact bounds. Pure.

Rule: `make_space(describe_space(space))` equals `space`, with the same order of keys, the same dtypes and the same bounds
bit for bit. A record that doesn't describe a space raises `BadMessage`, and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

import gymnasium
import numpy as np
from gymnasium import spaces

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import LARGEST, MAX_NAME, one_line
from millrace.protocol.envs.spaces import OBSERVATIONS
from millrace.protocol.errors import BadMessage, UsageError, first_line
from millrace.protocol.space_spec import (
    MAX_DEPTH,
    MAX_LEAVES,
    BoxSpace,
    DictSpace,
    DiscreteSpace,
    Dtype,
    MultiBinarySpace,
    MultiDiscreteSpace,
    SpaceSpec,
    TupleSpace,
)

DTYPES = frozenset(get_args(Dtype))
MAX_DIMENSIONS = 8


def describe_space(space: gymnasium.Space[Any], name: str = "space") -> SpaceSpec:
    """The record of a space. Raises `UsageError`, in which `name` names the space, if the space is not supported."""
    return _describe(space, name, 0)


def make_space(spec: SpaceSpec) -> gymnasium.Space[Any]:
    """The space that a record describes. The record must have passed `space_spec.check_size`.

    Raises `BadMessage`, and no other error, if there is no such space.
    """
    try:
        return _make(spec)
    except BadMessage:
        raise
    except Exception as error:  # gymnasium raises several types for invalid bounds
        raise BadMessage(f"{type(spec).__name__}: {type(error).__name__}: {one_line(first_line(error), 200)}") from error


# ------------------------------------------------------------------------------------------------------------ to a record


def _describe(space: gymnasium.Space[Any], name: str, depth: int) -> SpaceSpec:
    if depth > MAX_DEPTH:
        raise UsageError(f"{name}: expected at most {MAX_DEPTH} levels of Dict and Tuple, got more")
    match space:
        case spaces.Dict():
            return DictSpace(_keys(space.spaces, name), _inner(list(space.spaces.values()), name, depth))
        case spaces.Tuple():
            return TupleSpace(_inner(list(space.spaces), name, depth))
        case spaces.Box() if space.dtype.name in DTYPES and len(space.shape) <= MAX_DIMENSIONS:
            return BoxSpace(space.shape, _dtype(space), _compact(space.low), _compact(space.high))
        case spaces.Discrete() if int(space.n) <= LARGEST and abs(int(space.start)) <= LARGEST:
            return DiscreteSpace(int(space.n), int(space.start), _dtype(space))
        case spaces.MultiDiscrete() if space.nvec.ndim <= MAX_DIMENSIONS:
            return MultiDiscreteSpace(_dtype(space), _int64(space.nvec), _int64(space.start))
        case spaces.MultiBinary() if len(space.shape) <= MAX_DIMENSIONS:
            return MultiBinarySpace(tuple(space.shape))
        case _:
            raise UsageError(f"{name} {space} is not supported; supported are {OBSERVATIONS}")


def _inner(inside: list[gymnasium.Space[Any]], name: str, depth: int) -> tuple[SpaceSpec, ...]:
    if len(inside) > MAX_LEAVES:
        raise UsageError(f"{name}: expected at most {MAX_LEAVES} arrays, got {len(inside)}")
    return tuple(_describe(inner, name, depth + 1) for inner in inside)


def _keys(inside: Mapping[Any, object], name: str) -> tuple[str, ...]:
    for key in inside:
        if not isinstance(key, str) or one_line(key, MAX_NAME) != key:
            raise UsageError(
                f"{name}: expected keys of a Dict that are text of at most {MAX_NAME} characters, got {key!r:.60}"
            )
    return tuple(inside)


def _dtype(space: gymnasium.Space[Any]) -> Dtype:
    name: Dtype = np.dtype(space.dtype).name  # type: ignore[assignment]  # gymnasium allows no other dtypes here
    return name


def _compact(bound: Array) -> Array:
    """The bounds; or, if all of them are equal bit for bit, only one, as an array without dimensions."""
    flat = np.ascontiguousarray(bound).ravel()
    if flat.size and flat.tobytes() == flat[:1].tobytes() * flat.size:
        return flat[:1].reshape(())
    return np.ascontiguousarray(bound)


def _int64(array: Array) -> Array:
    return np.ascontiguousarray(array, np.int64)


# ---------------------------------------------------------------------------------------------------------- from a record


def _make(spec: SpaceSpec) -> gymnasium.Space[Any]:
    match spec:
        case DictSpace(keys, inside):
            if len(set(keys)) != len(inside) or len(keys) != len(inside):
                raise BadMessage(f"Dict space: expected a different key for each of {len(inside)} spaces, got {len(keys)}")
            return spaces.Dict([(key, _make(inner)) for key, inner in zip(keys, inside, strict=True)])
        case TupleSpace(inside):
            return spaces.Tuple([_make(inner) for inner in inside])
        case BoxSpace(shape, dtype, low, high):
            return spaces.Box(_bound("low", low, shape, dtype), _bound("high", high, shape, dtype), shape, np.dtype(dtype))
        case DiscreteSpace(n, start, dtype):
            _check_whole("Discrete space", dtype, start, start + n - 1)
            _check_whole("Discrete space", dtype, n, n)
            # Older versions of gymnasium know only int64.
            return spaces.Discrete(n, start=start) if dtype == "int64" else spaces.Discrete(n, start=start, dtype=dtype)
        case MultiDiscreteSpace(dtype, nvec, start):
            _check_multi_discrete(nvec, start, dtype)
            return spaces.MultiDiscrete(nvec, dtype=np.dtype(dtype), start=start)
        case MultiBinarySpace(shape):
            return spaces.MultiBinary(shape[0] if len(shape) == 1 else list(shape))


def _bound(name: str, bound: Array, shape: tuple[int, ...], dtype: Dtype) -> Array:
    """The bounds in full, [*shape]: the inverse of `_compact`."""
    if bound.dtype != np.dtype(dtype) or bound.shape not in ((), shape):
        raise BadMessage(f"Box space: {name}: expected {dtype}{shape} or one {dtype}, got {bound.dtype}{bound.shape}")
    if bound.dtype.kind == "f" and np.isnan(bound).any():
        raise BadMessage(f"Box space: {name}: expected numbers or infinities, got NaN")
    return np.full(shape, bound, dtype) if bound.shape == () else bound


def _check_multi_discrete(nvec: Array, start: Array, dtype: Dtype) -> None:
    if nvec.dtype != np.int64 or start.dtype != np.int64 or nvec.shape != start.shape:
        raise BadMessage(
            f"MultiDiscrete space: expected nvec and start of one shape and int64, got {nvec.dtype}{nvec.shape} and "
            f"{start.dtype}{start.shape}"
        )
    if not nvec.size:
        return
    fewest = int(nvec.min())
    most = int(nvec.max())
    first = int(start.min())
    last = int(start.max())
    if fewest < 1 or most > LARGEST or max(-first, last) > LARGEST:
        raise BadMessage(f"MultiDiscrete space: expected entries of 1 to {LARGEST} values, got {fewest} to {most}")
    _check_whole("MultiDiscrete space", dtype, first, int((start + nvec - 1).max()))
    _check_whole("MultiDiscrete space", dtype, 1, most)


def _check_whole(what: str, dtype: Dtype, low: int, high: int) -> None:
    if np.dtype(dtype).kind not in "iu":
        raise BadMessage(f"{what}: expected a dtype of whole numbers, got {dtype}")
    limits = np.iinfo(dtype)
    if low < limits.min or high > limits.max:
        raise BadMessage(f"{what}: expected values that fit {dtype}, got {low} to {high}")
