"""The orders to a lane: reset, step and call. Pure.

Each `..._order` function returns a function that makes the message once the session, the ticket and the incarnation of the
lane are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from millrace.learner.vector_env.order_coordinator import MakeOrder
from millrace.protocol.arrays import Array, Bytes
from millrace.protocol.messages import Call, LaneIncarnation, Reset, Step
from millrace.protocol.wire.plain_values import pack, pack_each


def packed(value: object) -> Bytes:
    """A plain value as an array of bytes. Raises `TypeError` if the value isn't plain data."""
    return np.frombuffer(pack(value), np.uint8)


def packed_each(values: Sequence[Any]) -> Bytes:
    """A list with one plain value for each copy, as an array of bytes. Raises `TypeError` if one isn't plain data."""
    return np.frombuffer(pack_each(values), np.uint8)


def reset_order(copies: Sequence[int], seeds: Sequence[int | None], options: Bytes) -> MakeOrder:
    """An order to begin episodes in these copies of the lane, with one seed each. `options` are packed."""

    def make(session: int, ticket: int, life: LaneIncarnation) -> Reset:
        return Reset(session, ticket, life.lane, life.incarnation, tuple(copies), tuple(seeds), options)

    return make


def step_order(actions: Sequence[Array]) -> MakeOrder:
    """An order to step all copies of the lane with these actions, [N, *leaf] each."""
    leaves = tuple(array.copy() for array in actions)

    def make(session: int, ticket: int, life: LaneIncarnation) -> Step:
        return Step(session, ticket, life.lane, life.incarnation, leaves)

    return make


def call_order(copies: Sequence[int], name: str, given: Bytes, *, assign: bool) -> MakeOrder:
    """An order to get, call or assign an attribute of these copies of the lane. `given`: packed arguments or values."""

    def make(session: int, ticket: int, life: LaneIncarnation) -> Call:
        return Call(session, ticket, life.lane, life.incarnation, tuple(copies), name, assign, given)

    return make
