"""The orders to a lane: reset, step and call. Pure.

Each function returns one that makes the message, as soon as session, ticket and incarnation of the lane are known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.learner.vector_env.order_coordinator import MakeOrder
from millrace.protocol.arrays import Array, Bytes
from millrace.protocol.messages import Call, LaneIncarnation, Reset, Step
from millrace.protocol.wire.plain_values import pack


def packed(value: object) -> Bytes:
    """A plain value as an array of bytes. Raises `TypeError` for what is not plain."""
    return np.frombuffer(pack(value), np.uint8)


def reset_order(copies: Sequence[int], seeds: Sequence[int | None], options: Bytes) -> MakeOrder:
    """Begin episodes in these copies of the lane, with one seed each. `options` are packed."""

    def make(session: int, ticket: int, life: LaneIncarnation) -> Reset:
        return Reset(session, ticket, life.lane, life.incarnation, tuple(copies), tuple(seeds), options)

    return make


def step_order(actions: Sequence[Array]) -> MakeOrder:
    """Step all copies of the lane with these actions: [N, *leaf] each."""
    leaves = tuple(array.copy() for array in actions)

    def make(session: int, ticket: int, life: LaneIncarnation) -> Step:
        return Step(session, ticket, life.lane, life.incarnation, leaves)

    return make


def call_order(copies: Sequence[int], name: str, arguments: object, *, assign: bool) -> MakeOrder:
    """Get or call the attribute of this name in these copies of the lane, or assign to it."""
    packed_arguments = packed(arguments)

    def make(session: int, ticket: int, life: LaneIncarnation) -> Call:
        return Call(session, ticket, life.lane, life.incarnation, tuple(copies), name, assign, packed_arguments)

    return make
