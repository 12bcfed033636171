"""Converts a Dict or Tuple of actions to one row of numbers, and back. Pure.

Rule: a row has the choices of all Discrete and MultiDiscrete parts, then the bits of all MultiBinary parts, then the numbers
of all Box parts. Within each of these three groups, the parts are in the order of the space. A mixed action therefore has at
most three distributions, whatever its parts are, and only the code that converts it for the environment needs to know the
parts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

from msgspec.structs import replace

from millrace.protocol.specs import ActionPart, ActionSpec

Path = tuple[str | int, ...]
"""The position of a part (`ActionPart.path`)."""


class PlacedPart(NamedTuple):
    """A part of a mixed action: its spec as a stand-alone action, and its place in the mixed action."""

    path: Path
    spec: ActionSpec
    columns: slice
    """its columns in a stored row"""


def mixed(parts: Sequence[tuple[Path, ActionSpec]]) -> ActionSpec:
    """The spec of the mixed action that has these parts, in the order of the space. No part may itself be mixed."""
    specs = [spec for _, spec in parts]
    return ActionSpec(
        "mixed",
        (sum(math.prod(spec.shape) for spec in specs),),
        "float32",
        sizes=tuple(size for spec in specs for size in spec.sizes),
        start=tuple(start for spec in specs for start in spec.start),
        low=tuple(low for spec in specs for low in spec.low),
        high=tuple(high for spec in specs for high in spec.high),
        parts=tuple(_part(path, spec) for path, spec in parts),
    )


def _part(path: Path, spec: ActionSpec) -> ActionPart:
    assert spec.kind != "mixed"
    return ActionPart(path, spec.kind, spec.shape, spec.dtype)


def parts_of(action: ActionSpec) -> list[PlacedPart]:
    """The parts of a mixed action, in the order of the space."""
    next_choice = 0
    next_bit = len(action.sizes)
    next_number = first_number = len(action.sizes) + action.bits
    found = []
    for part in action.parts:
        size = math.prod(part.shape)
        spec = ActionSpec(part.kind, part.shape, part.dtype)
        match part.kind:
            case "discrete" | "multidiscrete":
                columns = slice(next_choice, next_choice + size)
                next_choice = columns.stop
                spec = replace(spec, sizes=action.sizes[columns], start=action.start[columns])
            case "multibinary":
                columns = slice(next_bit, next_bit + size)
                next_bit = columns.stop
            case "box":
                columns = slice(next_number, next_number + size)
                next_number = columns.stop
                bounds = slice(columns.start - first_number, columns.stop - first_number)
                spec = replace(spec, low=action.low[bounds], high=action.high[bounds])
        found.append(PlacedPart(part.path, spec, columns))
    return found


Nest = Callable[[Sequence[Any]], Any]


def make_nest(paths: Sequence[Path]) -> Nest:
    """Return a function that takes one value for each of these paths, in this order, and puts them into a dict or tuple.

    If there is only one path, it may be empty: the function then returns the value itself. Raises `ValueError` unless the
    paths describe a Dict or Tuple.
    """
    return _nest(list(enumerate(paths)))


def _nest(placed: Sequence[tuple[int, Path]]) -> Nest:
    """Like `make_nest`, but for only some of the values. `placed` has each value's index, and the rest of its path."""
    number, path = placed[0]
    if not path and len(placed) == 1:
        return itemgetter(number)
    inside: dict[str | int, list[tuple[int, Path]]] = {}
    for number, path in placed:
        if not path:
            raise ValueError("expected a key or a number in each path, got an empty one")
        inside.setdefault(path[0], []).append((number, path[1:]))
    nests = {key: _nest(each) for key, each in inside.items()}
    keys = list(nests)
    if keys == list(range(len(keys))):
        of_places = list(nests.values())
        return lambda values: tuple([nest(values) for nest in of_places])
    if not all(isinstance(key, str) for key in keys):
        raise ValueError(f"expected keys of a Dict, or the numbers of all places of a Tuple, got {keys[:10]}")
    return lambda values: {key: nest(values) for key, nest in nests.items()}
