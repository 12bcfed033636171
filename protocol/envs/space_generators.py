"""Gymnasium spaces' random generators as text, so that a seeded space draws the same samples in another process. Pure.

Rule: only existing generators are described. A space that was never seeded has none, and makes one when it is first sampled.
Generators other than PCG64, which gymnasium uses, are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from millrace.protocol.errors import BadMessage


def generator_states(*given: gymnasium.Space[Any]) -> tuple[str, ...]:
    """The generator states of these spaces and the spaces inside them; empty if no space has a generator."""
    states = [_state(space) for outer in given for space in _with_inner(outer)]
    return tuple(states) if any(states) else ()


def restore_generators(states: Sequence[str], *given: gymnasium.Space[Any]) -> None:
    """Give new spaces generators with these states. Raises `BadMessage` unless there is one state per space, or no state."""
    every = [space for outer in given for space in _with_inner(outer)] if states else []
    if len(states) != len(every):
        raise BadMessage(f"generators: expected one for each of {len(every)} spaces, got {len(states)}")
    for space, state in zip(every, states, strict=True):
        if state:
            space._np_random = _generator(state)


def _with_inner(space: gymnasium.Space[Any]) -> Iterator[gymnasium.Space[Any]]:
    yield space
    if isinstance(space, spaces.Dict | spaces.Tuple):
        for inner in space.values() if isinstance(space, spaces.Dict) else space:
            yield from _with_inner(inner)


def _state(space: gymnasium.Space[Any]) -> str:
    """The state of this space's generator, as a `millrace.protocol.space_spec.GeneratorState`.

    It isn't read from `space.np_random`, because that would seed an unseeded space.
    """
    generator: np.random.Generator | None = space._np_random
    if generator is None or not isinstance(generator.bit_generator, np.random.PCG64):
        return ""
    state: Any = generator.bit_generator.state
    return f"{state['state']['state']:032x}{state['state']['inc']:032x}{state['has_uint32']:x}{state['uinteger']:08x}"


def _generator(state: str) -> np.random.Generator:
    generator = np.random.PCG64(0)
    generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": int(state[:32], 16), "inc": int(state[32:64], 16)},
        "has_uint32": int(state[64]),
        "uinteger": int(state[65:], 16),
    }
    return np.random.Generator(generator)
