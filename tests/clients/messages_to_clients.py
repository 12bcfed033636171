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

SESSION = 77
CARTPOLE = EnvSpec("CartPole-v1")
OBSERVATION = Leaf("", "box", (4,), "float32")
STEP = StepSpec((CARTPOLE,), (0,) * 4, (2, 2), (OBSERVATION,), (Leaf("", "discrete", (), "int64", (2,), (0,)),))
POLICY = PolicySpec((OBSERVATION,), ActionSpec("discrete", (), "int64", (2,), (0,)), net=(8,))
OPTIONS = np.frombuffer(pack(None), np.uint8)
FEW = (Received(0, 0, 1), Received(1, 0, 3, (5, 6)))


def messages(lanes: int) -> list[ToWorker]:
    """Every type of message, in an order in which a client obeys them. With one lane of a run, that has one copy."""
    weights = np.linspace(-1, 1, acting_size(POLICY), dtype=np.float32)
    return [
        Welcome(SESSION, 1, WaitSpec()),
        Describe(SESSION, 20, CARTPOLE),
        Welcome(SESSION, 1, STEP),
        Reset(SESSION, 1, 0, 0, (0, 1), (5, None), OPTIONS),
        Step(SESSION, 2, 0, 0, (np.array([0, 1]),)),
        Step(SESSION, 3, 1, 2, (np.array([1, 1]),)),
        Call(SESSION, 4, 0, 0, (0,), "spec", False, OPTIONS),
        Release(SESSION, (LaneIncarnation(0, 0),)),
        HeartbeatReply(SESSION, 1, FEW),
        Rejoin(SESSION),
        Welcome(SESSION, 2, RunSpec(CARTPOLE, POLICY, rollout_steps=64, copies=lanes, lanes=lanes, seed=1)),
        Collect(SESSION, 3, (Permit(10, 0, 0, 0), Permit(11, 1, 1, 0))[:lanes], FEW[:lanes], (3,)),
        Weights(3, weights, np.zeros(0, np.float32)),
        Evaluate(SESSION, 12, 4, (1, 2), True, 30, False, False),
        Weights(4, to_wire_dtype(weights, "bfloat16"), np.zeros(0, np.float32)),
        HeartbeatReply(SESSION, 2, FEW[:1]),
        Drain("the run is over"),
        Refuse("no"),
        Welcome(SESSION, 3, RunSpec(CARTPOLE, POLICY, 4, 2, 2, 1, facts=("return_a", "return_b"), seats=("a", "b"))),
    ]


def corpus(lanes: int = 2) -> bytes:
    """For each message: the number of its frames, then the length and the bytes of each. Numbers are `<u4`."""
    parts, told = [], messages(lanes)
    assert {type(message) for message in told} == set(get_args(ToWorker))
    for message in told:
        frames = encode(message)
        parts.append(struct.pack("<I", len(frames)))
        parts += [struct.pack("<I", len(bytes(frame))) + bytes(frame) for frame in frames]
    return b"".join(parts)
