"""The infos of one lane: packed bytes to one dict for each env copy; and gymnasium's merging for some copies. Pure."""

from __future__ import annotations

from typing import Any

from gymnasium.vector import VectorEnv

from protocol.arrays import Array
from protocol.errors import BadMessage
from protocol.wire.plain_values import unpack

Infos = dict[str, Any]


class OfSomeCopies(VectorEnv[Any, Any, Array]):
    """Merges the infos of some copies, as gymnasium's vector environments merge those of all."""

    closed = True  # there is nothing to close

    def __init__(self, count: int) -> None:
        self.num_envs = count


def unpack_infos(packed: bytes, copies: range) -> dict[int, Infos]:
    """Infos by env copy, of a lane that has these copies. Raises `BadMessage` for bytes that are no infos."""
    try:
        pairs = [(n, info) for n, info in unpack(packed)]
    except (TypeError, ValueError) as error:
        raise BadMessage(str(error)) from error
    for n, info in pairs:
        if type(n) is not int or not isinstance(info, dict):
            raise BadMessage(f"expected pairs of a number and a dict, got {type(n).__name__} and {type(info).__name__}")
    return {copies[n]: info for n, info in pairs if n in range(len(copies))}
