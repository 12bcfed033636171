"""gymnasium spaces as plain data, and observations as arrays. Pure.

A Dict or Tuple observation becomes one array per leaf, in the space's order. Leaves keep their raw dtype; only the policy
turns them into features.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium import spaces

from millrace.protocol.action_parts import mixed
from millrace.protocol.arrays import Array
from millrace.protocol.errors import UsageError
from millrace.protocol.specs import ActionSpec, Leaf

OBSERVATIONS = "Box, Discrete, MultiBinary, MultiDiscrete, and Dict and Tuple of these"
ACTIONS = "Discrete, MultiDiscrete, MultiBinary and Box (of floats), and Dict and Tuple of these"
MOST_CHOICES = 2**24  # choices of one part of a mixed action; a float32 can't represent larger whole numbers exactly
STORED_KINDS = "biuf"  # bool, integers, floats: the dtypes that a message can carry


def observation_leaves(space: gymnasium.Space[Any]) -> tuple[Leaf, ...]:
    """Describe each array of an observation. Raises `UsageError` for a space that is not supported."""
    return tuple(_leaf("/".join(map(str, path)), leaf) for path, leaf in _walk(space, ()))


def leaves_with_own_dtype(space: gymnasium.Space[Any]) -> tuple[Leaf, ...]:
    """Describe each array of an observation or action, with the dtype of its space.

    Raises `UsageError` for a space that is not supported.
    """
    leaves = zip(observation_leaves(space), _walk(space, ()), strict=True)
    return tuple(msgspec.structs.replace(leaf, dtype=np.dtype(inner.dtype).name) for leaf, (_, inner) in leaves)


def make_unflatten(space: gymnasium.Space[Any]) -> Callable[[Sequence[Any]], Any]:
    """The inverse of `make_flatten`: return a function that converts leaves, in order, to an observation or an action."""
    paths = [path for path, _ in _walk(space, ())]
    if paths == [()]:
        return lambda leaves: leaves[0]

    def nest(space: gymnasium.Space[Any], leaves: Iterator[Any]) -> Any:
        match space:
            case spaces.Dict():
                return {key: nest(inner, leaves) for key, inner in space.spaces.items()}
            case spaces.Tuple():
                return tuple(nest(inner, leaves) for inner in space.spaces)
            case _:
                return next(leaves)

    return lambda leaves: nest(space, iter(leaves))


def make_batched(space: gymnasium.Space[Any]) -> Callable[[Array], Any]:
    """Return a function that converts the actions of N copies to the batch that a vector environment expects.

    Its argument has the form that `action_converter_of` describes. Actions of a Dict or Tuple space become one dict or tuple
    of arrays [N, *part].
    """
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        return lambda actions: actions
    flatten = make_flatten(space)
    unflatten = make_unflatten(space)
    return lambda actions: unflatten([np.stack(leaf) for leaf in zip(*map(flatten, actions), strict=True)])


def _walk(space: gymnasium.Space[Any], path: tuple[str | int, ...]) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    match space:
        case spaces.Dict():
            for key, inner in space.spaces.items():
                yield from _walk(inner, (*path, key))
        case spaces.Tuple():
            for index, inner in enumerate(space.spaces):
                yield from _walk(inner, (*path, index))
        case _:
            yield path, space


def _leaf(path: str, space: gymnasium.Space[Any]) -> Leaf:
    match space:
        case spaces.Box() if space.dtype.kind in STORED_KINDS and space.dtype.itemsize <= 8:
            return Leaf(path, "box", space.shape, space.dtype.name, divisor=255 if _has_all_bytes(space) else 1)
        case spaces.Discrete():
            return Leaf(path, "discrete", (), "int64", (int(space.n),), (int(space.start),))
        case spaces.MultiDiscrete():
            return Leaf(path, "multidiscrete", space.shape, "int64", _ints(space.nvec), _ints(space.start))
        case spaces.MultiBinary():
            return Leaf(path, "multibinary", space.shape, "int8")
        case _:
            where = f" at {path}" if path else ""
            raise UsageError(f"observation space {space}{where} is not supported; supported are {OBSERVATIONS}")


def _has_all_bytes(space: spaces.Box) -> bool:
    """Whether the values are bytes with bounds 0 and 255. Such values are divided by 255 before a network gets them. With
    other bounds, such as those of flags, a byte is an ordinary number.
    """
    return space.dtype == np.uint8 and bool((space.low == 0).all() and (space.high == 255).all())


def with_last(space: gymnasium.Space[Any], keys: Sequence[str]) -> gymnasium.Space[Any]:
    """A Dict space with these keys moved to its end. Any other space is returned as it is."""
    if not keys or not isinstance(space, spaces.Dict):
        return space
    return spaces.Dict([*((k, v) for k, v in space.spaces.items() if k not in keys), *((k, space.spaces[k]) for k in keys)])


def action_spec(space: gymnasium.Space[Any]) -> ActionSpec:
    """Describe the action. Raises `UsageError` for a space that is not supported."""
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        return _single_action(space, "")
    if _has_nothing(space):
        raise UsageError(f"action space {space}: expected at least one space in each Dict and Tuple, got an empty one")
    found = mixed([(path, _single_action(inner, "/".join(map(str, path)))) for path, inner in _walk(space, ())])
    if max(found.sizes, default=0) > MOST_CHOICES:
        raise UsageError(f"action space {space}: expected at most {MOST_CHOICES:,} choices, got {max(found.sizes):,}")
    return found


def _has_nothing(space: gymnasium.Space[Any]) -> bool:
    """Whether the space is, or contains, an empty Dict or Tuple."""
    match space:
        case spaces.Dict(spaces=inside):
            return not inside or any(map(_has_nothing, inside.values()))
        case spaces.Tuple(spaces=inside):
            return not inside or any(map(_has_nothing, inside))
        case _:
            return False


def _single_action(space: gymnasium.Space[Any], path: str) -> ActionSpec:
    """The spec of a space that isn't a Dict or Tuple. `path` is its position in the Dict or Tuple around it, if any."""
    where = f" at {path}" if path else ""
    if space.shape is not None and 0 in space.shape:
        expected = f"expected at least one number to choose, got shape {list(space.shape)}"
        raise UsageError(f"action space {space}{where}: {expected}")
    match space:
        case spaces.Discrete():
            return ActionSpec("discrete", (), "int64", (int(space.n),), (int(space.start),))
        case spaces.MultiDiscrete():
            return ActionSpec("multidiscrete", space.shape, space.dtype.name, _ints(space.nvec), _ints(space.start))
        case spaces.MultiBinary():
            return ActionSpec("multibinary", space.shape, space.dtype.name)
        case spaces.Box() if space.dtype.kind == "f":
            low, high = (tuple(float(x) for x in bound.ravel()) for bound in (space.low, space.high))
            return ActionSpec("box", space.shape, space.dtype.name, low=low, high=high)
        case _:
            raise UsageError(f"action space {space}{where} is not supported; supported are {ACTIONS}")


def _ints(array: Array) -> tuple[int, ...]:
    return tuple(int(x) for x in array.ravel())


def make_flatten(space: gymnasium.Space[Any]) -> Callable[[Any], tuple[Any, ...]]:
    """Return a function that splits one observation (or a vector environment's batch of them) into its leaves, in order."""
    paths = [path for path, _ in _walk(space, ())]
    if paths == [()]:
        return lambda observation: (observation,)

    def read(observation: Any) -> tuple[Any, ...]:
        leaves = []
        for path in paths:
            leaf = observation
            for key in path:
                leaf = leaf[key]
            leaves.append(leaf)
        return tuple(leaves)

    return read
