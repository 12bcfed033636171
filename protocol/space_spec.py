"""An environment as plain data: its spaces with exact bounds, its metadata and its time limit. It is sent in `Described`.

Rule: sizes are checked before anything of that size is allocated. `check_size` checks a peer's description before its spaces
are made.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import Count, Line, Name, Natural, Text, Whole
from millrace.protocol.errors import BadMessage

MAX_LEAVES = 48  # arrays in an observation; a rollout sends each one in a frame of its own
MAX_DEPTH = 8
MAX_WRAPPERS = 1 << 8  # classes of an environment's wrappers
MAX_SPACES = 1 << 12  # spaces of an environment, including nested ones, whose random generators are sent
MAX_SEATS = 1 << 10  # agents of an environment
MAX_ELEMENTS = 1 << 24  # total elements across all leaves of a space

Shape = Annotated[tuple[Natural, ...], Meta(max_length=8)]
Dtype = Literal[
    "bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float16", "float32", "float64"
]


class BoxSpace(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """`gymnasium.spaces.Box`. `low` and `high` have the dtype of the space."""

    shape: Shape
    dtype: Dtype
    low: Array
    """[*shape], or [] if all lower bounds are equal"""
    high: Array
    """[*shape], or [] if all upper bounds are equal"""


class DiscreteSpace(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """`gymnasium.spaces.Discrete`."""

    n: Count
    start: Whole
    dtype: Dtype


class MultiDiscreteSpace(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """`gymnasium.spaces.MultiDiscrete`."""

    dtype: Dtype
    nvec: Array
    """[*shape] int64"""
    start: Array
    """[*shape] int64"""


class MultiBinarySpace(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """`gymnasium.spaces.MultiBinary`."""

    shape: Shape


class DictSpace(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """`gymnasium.spaces.Dict`."""

    keys: Annotated[tuple[Name, ...], Meta(max_length=MAX_LEAVES)]
    spaces: Annotated[
        tuple[BoxSpace | DiscreteSpace | MultiDiscreteSpace | MultiBinarySpace | DictSpace | TupleSpace, ...],
        Meta(max_length=MAX_LEAVES),
    ]


class TupleSpace(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """`gymnasium.spaces.Tuple`."""

    spaces: Annotated[
        tuple[BoxSpace | DiscreteSpace | MultiDiscreteSpace | MultiBinarySpace | DictSpace | TupleSpace, ...],
        Meta(max_length=MAX_LEAVES),
    ]


SpaceSpec = BoxSpace | DiscreteSpace | MultiDiscreteSpace | MultiBinarySpace | DictSpace | TupleSpace


GeneratorState = Annotated[str, Meta(pattern=r"^([0-9a-f]{64}[01][0-9a-f]{8})?\Z")]
"""State of numpy's PCG64 in hexadecimal digits: 32 for its state, 32 for its increment, 1 for whether half of a drawn number
is left over, 8 for that half. Empty if there is no generator.
"""


class EnvDescription(msgspec.Struct, frozen=True, array_like=True):
    """All that the learner knows about the environment."""

    observation: SpaceSpec
    action: SpaceSpec
    metadata: Array
    """[bytes] uint8: the entries of `Env.metadata` that are plain data, packed by `plain_values`"""
    spec: Text
    """gymnasium's `EnvSpec` as JSON; empty if the environment has none, or one that JSON cannot represent"""
    longest_episode: Natural
    """time limit in env steps; 0 if there is none"""
    render_mode: Name
    generators: Annotated[tuple[GeneratorState, ...], Meta(max_length=MAX_SPACES)] = ()
    """the random generator of each space, if any is seeded: that of the observation space, those of the spaces inside it,
    depth first, then likewise for the action space. With them, the learner draws the same samples as the environment would
    """
    wrappers: Annotated[tuple[Line, ...], Meta(max_length=MAX_WRAPPERS)] = ()
    """the classes of the copy's gymnasium wrappers, as `module:Class`, and the wrapper classes from which these derive"""
    seats: Annotated[tuple[Name, ...], Meta(max_length=MAX_SEATS)] = ()
    """the agents' names, if the environment has several or has PettingZoo's interface; the spaces are those of each agent"""
    takes_turns: bool = False
    """whether a seat may have to wait for others between two of its actions"""


def check_size(description: EnvDescription) -> None:
    """Raise `BadMessage` if the spaces exceed the limits on leaves, nesting or elements. Allocates nothing."""
    for name, space in (("observation", description.observation), ("action", description.action)):
        check_space(f"{name} space", space)


def check_space(name: str, space: SpaceSpec) -> None:
    """Like `check_size`, for one space. `name` is its name in errors."""
    leaves = list(_leaves(space, 0))
    if len(leaves) > MAX_LEAVES:
        raise BadMessage(f"{name}: expected at most {MAX_LEAVES} arrays, got {len(leaves)}")
    elements = sum(leaves)
    if elements > MAX_ELEMENTS:
        raise BadMessage(f"{name}: expected at most {MAX_ELEMENTS} elements, got {elements}")


def _leaves(space: SpaceSpec, depth: int) -> Iterator[int]:
    """The number of elements of each array. Raises `BadMessage` if the space is nested too deeply."""
    if depth > MAX_DEPTH:
        raise BadMessage(f"space: expected at most {MAX_DEPTH} levels of Dict and Tuple, got more")
    match space:
        case DictSpace(_, spaces) | TupleSpace(spaces):
            for inner in spaces:
                yield from _leaves(inner, depth + 1)
        case BoxSpace(shape) | MultiBinarySpace(shape):
            yield math.prod(shape)
        case MultiDiscreteSpace(_, nvec):
            yield nvec.size
        case DiscreteSpace():
            yield 1
