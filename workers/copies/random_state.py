"""The state of an environment's own random generator, on which a reset without a seed depends in deterministic environments.

Rule: it is read only from gymnasium's `np_random`, which `super().reset(seed=...)` makes. If an environment draws from
anything else, or has no generator, its state cannot be read.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from millrace.protocol.envs.seats import SeatedEnv
from millrace.workers.copies.reset_ahead import ResetAhead

BYTES = 16 + 16 + 4 + 1
"""size of a packed state: PCG64's state and increment, and a buffered half of the last number that it drew"""
ATTRIBUTES = ("_np_random", "np_random")
"""Where environments keep their generator: those of gymnasium, and those of PettingZoo by convention."""


def repeatable(env: gymnasium.Env[Any, Any]) -> Any | None:
    """The environment inside all wrappers, if its generator alone decides what a reset without a seed does; else None."""
    inner: Any = env
    while isinstance(inner, gymnasium.Wrapper):
        if isinstance(inner, ResetAhead):
            return None  # two instances take turns, each with its own generator
        inner = inner.env
    if isinstance(inner, SeatedEnv):
        inner = getattr(inner.env, "unwrapped", inner.env)
    return inner


def state_of(inner: Any | None) -> dict[str, Any] | None:
    """The state of the generator of an environment inside all wrappers; None if it has no readable one."""
    generator = _generator(inner)
    return None if generator is None else generator.bit_generator.state  # type: ignore[return-value]  # a new dict


def pack(state: dict[str, Any] | None) -> bytes | None:
    """The state in `BYTES` bytes."""
    if state is None:
        return None
    of_pcg64 = state["state"]
    halves = of_pcg64["state"].to_bytes(16, "little"), of_pcg64["inc"].to_bytes(16, "little")
    return b"".join((*halves, state["uinteger"].to_bytes(4, "little"), bytes([state["has_uint32"]])))


def set_state(inner: Any | None, packed: bytes) -> bool:
    """Set a packed state. False if the environment has no generator that it fits."""
    generator = _generator(inner)
    if generator is None or len(packed) != BYTES or not packed[16] & 1:  # PCG64 adds an odd number
        return False
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": int.from_bytes(packed[:16], "little"), "inc": int.from_bytes(packed[16:32], "little")},
        "uinteger": int.from_bytes(packed[32:36], "little"),
        "has_uint32": packed[36],
    }
    return True


def _generator(inner: Any | None) -> np.random.Generator | None:
    """The environment's generator, unless it is a property of the class: reading it would create one."""
    own = getattr(inner, "__dict__", {})
    for name in ATTRIBUTES:
        generator = own.get(name)
        if isinstance(generator, np.random.Generator) and type(generator.bit_generator) is np.random.PCG64:
            return generator
    return None
