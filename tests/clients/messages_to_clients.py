"""Valid messages of a learner, as bytes: what the fuzz programs of the clients mutate."""

from __future__ import annotations

import struct
from typing import get_args

import numpy as np

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import (
    Call,
    Collect,
    Describe,
    Drain,
    Evaluate,
    HeartbeatReply,
    LaneIncarnation,
    Permit,
    Received,
    Refuse,
    Rejoin,
    Release,
    Reset,
    Step,
    ToWorker,
    Weights,
    Welcome,
)
from millrace.protocol.policy.layout import acting_size
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec, RunSpec, StepSpec, WaitSpec
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.plain_values import pack
from millrace.protocol.wire.weight_dtypes import to_wire_dtype
from tests.support.conversation.example_messages import example, example_of_session

SESSION = 77
CARTPOLE = EnvSpec("CartPole-v1")
OBSERVATION = Leaf("", "box", (4,), "float32")
STEP = StepSpec((CARTPOLE,), (0,) * 4, (2, 2), (OBSERVATION,), (Leaf("", "discrete", (), "int64", (2,), (0,)),))
POLICY = PolicySpec((OBSERVATION,), ActionSpec("discrete", (), "int64", (2,), (0,)), net=(8,))
OPTIONS = np.frombuffer(pack(None), np.uint8)
FEW = (Received(0, 0, 1), Received(1, 0, 3, (5, 6)))


def messages(lanes: int) -> list[ToWorker]:
    """Messages in an order in which a client obeys them. With one lane of a run, that has one copy."""
    weights = np.linspace(-1, 1, acting_size(POLICY), dtype=np.float32)
    return [
        Welcome(SESSION, 1, WaitSpec()),
        Describe(SESSION, 20, CARTPOLE),
        Welcome(SESSION, 1, STEP),
        example(Reset, session=SESSION, ticket=1, copies=(0, 1), seeds=(5, None), options=OPTIONS),
        example(Step, session=SESSION, ticket=2, actions=(np.array([0, 1]),)),
        example(Step, session=SESSION, ticket=3, lane=1, incarnation=2, actions=(np.array([1, 1]),)),
        example(Call, session=SESSION, ticket=4, copies=(0,), name="spec", given=OPTIONS),
        Release(SESSION, (LaneIncarnation(0, 0),)),
        HeartbeatReply(SESSION, 1, FEW),
        Rejoin(SESSION),
        Welcome(SESSION, 2, RunSpec(CARTPOLE, POLICY, rollout_steps=64, copies=lanes, lanes=lanes, seed=1)),
        example(
            Collect,
            session=SESSION,
            version=3,
            permits=(example(Permit, ticket=10), example(Permit, ticket=11, lane=1, incarnation=1))[:lanes],
            received=FEW[:lanes],
            keep=(3,),
        ),
        Weights(3, weights, np.zeros(0, np.float32)),
        example(Evaluate, session=SESSION, ticket=12, version=4, seeds=(1, 2), greedy=True, most_steps=30),
        Weights(4, to_wire_dtype(weights, "bfloat16"), np.zeros(0, np.float32)),
        HeartbeatReply(SESSION, 2, FEW[:1]),
        Drain("the run is over"),
        Refuse("no"),
        Welcome(SESSION, 3, RunSpec(CARTPOLE, POLICY, 4, 2, 2, 1, seats=("a", "b"))),
    ]


def corpus(lanes: int = 2) -> bytes:
    """For each message: the number of its frames, then the length and the bytes of each. Numbers are `<u4`."""
    parts, told = [], messages(lanes)
    kinds = {type(message) for message in told}
    told += [example_of_session(kind, SESSION) for kind in get_args(ToWorker) if kind not in kinds]
    for message in told:
        frames = encode(message)
        parts.append(struct.pack("<I", len(frames)))
        parts += [struct.pack("<I", len(bytes(frame))) + bytes(frame) for frame in frames]
    return b"".join(parts)
