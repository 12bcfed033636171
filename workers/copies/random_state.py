"""The state of an environment's own random generator. In deterministic environments, it determines a reset without a seed.

Rule: the state is read only from gymnasium's `np_random`, which `super().reset(seed=...)` creates. If an environment draws
from another generator, or has none, the state cannot be read.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from millrace.protocol.envs.seats import SeatedEnv
from millrace.workers.copies.reset_ahead import ResetAhead

BYTES = 16 + 16 + 4 + 1
"""size of a packed state: PCG64's state, its increment, the unused half of a number that was drawn, and whether there is
such a half
"""
ATTRIBUTES = ("_np_random", "np_random")
"""The attributes in which environments keep their generator: the first in gymnasium, the second in PettingZoo by convention.
"""


def repeatable(env: gymnasium.Env[Any, Any]) -> Any | None:
    """The environment inside all wrappers, if its generator alone determines a reset without a seed; else None."""
    inner: Any = env
    while isinstance(inner, gymnasium.Wrapper):
        if isinstance(inner, ResetAhead):
            return None  # two instances take turns, each with its own generator
        inner = inner.env
    if isinstance(inner, SeatedEnv):
        layer = inner.env
        inner = getattr(layer, "unwrapped", layer)
        while layer is not inner:
            if isinstance(layer, ResetAhead):
                return None
            layer = getattr(layer, "env", inner)
    return inner


def state_of(inner: Any | None) -> dict[str, Any] | None:
    """The state of the generator of `inner`, an environment without wrappers; None if it can't be read."""
    generator = _generator(inner)
    return None if generator is None else generator.bit_generator.state  # type: ignore[return-value]  # a new dict


def pack(state: dict[str, Any] | None) -> bytes | None:
    """The state as `BYTES` bytes; None if there is none."""
    if state is None:
        return None
    of_pcg64 = state["state"]
    halves = of_pcg64["state"].to_bytes(16, "little"), of_pcg64["inc"].to_bytes(16, "little")
    return b"".join((*halves, state["uinteger"].to_bytes(4, "little"), bytes([state["has_uint32"]])))


def set_state(inner: Any | None, packed: bytes) -> bool:
    """Set a packed state. Returns False if the environment has no readable generator, or the state isn't a valid one."""
    generator = _generator(inner)
    if generator is None or len(packed) != BYTES or not packed[16] & 1:  # the increment of PCG64 is odd
        return False
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": int.from_bytes(packed[:16], "little"), "inc": int.from_bytes(packed[16:32], "little")},
        "uinteger": int.from_bytes(packed[32:36], "little"),
        "has_uint32": packed[36],
    }
    return True


def _generator(inner: Any | None) -> np.random.Generator | None:
    """The environment's generator; None if it has none yet. It isn't read through a property, which would create one."""
    own = getattr(inner, "__dict__", {})
    for name in ATTRIBUTES:
        generator = own.get(name)
        if isinstance(generator, np.random.Generator) and type(generator.bit_generator) is np.random.PCG64:
            return generator
    return None
