"""The orders of a vector environment and their answers, as plain tuples, and back.

Rule: a lane has one copy, whose state is two numbers: the seed of its last reset, and the steps since. An answer carries the
state after its order, so a result of another order, or of an order that was executed twice, shows.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from millrace.learner.vector_env.lane_orders import call_order, packed, reset_order, step_order
from millrace.learner.vector_env.order_coordinator import MakeOrder
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import (
    Answer,
    Call,
    LaneIncarnation,
    Order,
    Reset,
    Returned,
    Step,
    Stepped,
    ToLearner,
    ToWorker,
)
from millrace.protocol.specs import Leaf, StepSpec
from millrace.protocol.wire.plain_values import pack, unpack
from tests.model import message_content
from tests.model.conversation import Content
from tests.model.message_content import incarnation, session, ticket

Copy = tuple[int, int]
"""State of a copy: the seed of its last reset, and the steps since."""
NEW: Copy = (-1, 0)
"""A copy that was never reset."""
NOTHING = packed(None)


@cache
def step_spec(lanes: int, heartbeat_s: float, learner_timeout_s: float) -> StepSpec:
    """One copy in each lane."""
    return StepSpec(
        envs=(EnvSpec("Fake-v0"),),
        copies=(0,) * lanes,
        lanes=(1,) * lanes,
        observation=(Leaf("", "box", (1,), "float32"),),
        action=(Leaf("", "discrete", (), "int64", (2,), (0,)),),
        heartbeat_s=heartbeat_s,
        learner_timeout_s=learner_timeout_s,
    )


def make_order(kind: str, seed: int) -> MakeOrder:
    """The order of this kind for a lane. `seed` is that of a reset."""
    if kind == "reset":
        return reset_order([0], [seed], NOTHING)
    return (
        step_order([np.zeros(1, np.int64)]) if kind == "step" else call_order([0], "state", packed(((), {})), assign=False)
    )


def executed(order: Order, before: Copy) -> Copy:
    """The state of a copy after this order."""
    match order:
        case Reset():
            return order.seeds[0] or 0, 0
        case Step():
            assert before != NEW, "a Step of copies that were never reset"
            return before[0], before[1] + 1
        case Call():
            return before


def answer(order: Order, after: Copy) -> Answer:
    """The answer to the order, with this state."""
    if isinstance(order, Call):
        return _returned(order.session, order.ticket, order.lane, order.incarnation, after)
    return _stepped(order.session, order.ticket, order.lane, order.incarnation, after)


def state_in(message: Answer) -> Copy:
    """The state that an answer carries."""
    if isinstance(message, Returned):
        ((seed, steps),) = unpack(message.results.data)
        return seed, steps
    return int(message.obs[0][0, 0]), int(message.reward[0])


def order_content(order: Order) -> Content:
    """An order, without its session, which is that of its worker."""
    kind, seed = type(order).__name__.lower(), order.seeds[0] if isinstance(order, Reset) else 0
    return kind, seed, ticket(order.ticket), order.lane, incarnation(order.lane, order.incarnation)


def order_of(number: int, content: Content) -> Order:
    """The order of this content in a session."""
    kind, seed, each, lane, inc = content
    return make_order(kind, seed)(number, each.value, LaneIncarnation(lane, inc.value))


def content_of(message: ToLearner | ToWorker, worker: int) -> Content:
    """`worker`: the number of the worker that sends or receives it."""
    match message:
        case Reset() | Step() | Call():
            return "Order", session(message.session), *order_content(message)
        case Stepped() | Returned():
            life = incarnation(message.lane, message.incarnation)
            kind = type(message).__name__
            return kind, session(message.session), ticket(message.ticket), message.lane, life, state_in(message)
    return message_content.content_of(message, worker)


def message_of(content: Content, worker: int, run: StepSpec) -> Any:
    """The message of this content, from or to this worker."""
    match content:
        case "Order", number, *order:
            return order_of(number.value, tuple(order))
        case "Stepped", number, each, lane, life, state:
            return _stepped(number.value, each.value, lane, life.value, state)
        case "Returned", number, each, lane, life, state:
            return _returned(number.value, each.value, lane, life.value, state)
    return message_content.message_of(content, worker, run)


def _stepped(number: int, of_ticket: int, lane: int, life: int, state: Copy) -> Stepped:
    flag = np.zeros(1, bool)
    obs = (np.full((1, 1), state[0], np.float32),)
    return Stepped(number, of_ticket, lane, life, obs, np.full(1, float(state[1])), flag, flag, np.zeros(0, np.uint8))


def _returned(number: int, of_ticket: int, lane: int, life: int, state: Copy) -> Returned:
    results: Array = np.frombuffer(pack([list(state)]), np.uint8)
    return Returned(number, of_ticket, lane, life, results, "", "")
