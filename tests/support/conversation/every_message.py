"""A good message of each kind that a worker or a learner can send: what tests of every message go through.

Rule: the lists are complete (`tests/protocol/wire/test_link.py`). Who adds a message to the protocol adds its example here.
"""

from __future__ import annotations

import numpy as np

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import (
    PROTOCOL_VERSION,
    Alive,
    Call,
    Collect,
    Describe,
    Described,
    Drain,
    EpisodeRows,
    Evaluate,
    Evaluated,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    LaneIncarnation,
    Permit,
    Received,
    Refuse,
    Rejoin,
    Release,
    Reset,
    Returned,
    Step,
    Stepped,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
    WorkerActivity,
    WorkerExit,
)
from millrace.protocol.rollout import Episode
from millrace.protocol.space_spec import BoxSpace, DictSpace, DiscreteSpace, EnvDescription, MultiBinarySpace, TupleSpace
from millrace.protocol.wire.plain_values import pack
from tests.support.conversation.fake_ends import fake_rollout, run_spec

PACKED = np.frombuffer(pack([(0, {"ünï": [1.5, "text"]})]), np.uint8)
BOX = BoxSpace((2,), "float32", np.full(2, -1, np.float32), np.ones((), np.float32))
BOXES = DictSpace(("a", "b"), (BOX, TupleSpace((MultiBinarySpace((3,)),))))


def to_learner(session: int, worker: str = "w0", nonce: int = 1) -> list[ToLearner]:
    """What this worker may say in this session."""
    return [
        Hello(PROTOCOL_VERSION, worker, "host", 1, nonce, "fake", nonce),
        fake_rollout(session, 0, 0, 0, 0),
        Heartbeat(session, 0, (0,), (1, 2), 5, {"act": 0.1}, 0),
        Goodbye(session, "told to stop", (1,)),
        Failure(session, "ValueError: ünïcode", "Traceback: …", 0),
        Stepped(session, 1, 0, 0, (np.ones((2, 4)),), np.ones(2), np.zeros(2, bool), np.ones(2, bool), PACKED),
        Returned(session, 1, 0, 0, PACKED, "ValueError: ünïcode", "Traceback: …"),
        Described(session, 1, EnvDescription(BOXES, DiscreteSpace(2, 0, "int64"), PACKED, "{}", 500, "human")),
        EpisodeRows(session, 1, 0, 0, (np.ones((3, 4)),), np.ones(2), np.ones(2), np.zeros(2, bool), np.ones(2, bool)),
        Evaluated(session, 1, (Episode(1.5, 2, 0.1),), (False,)),
        Alive((WorkerActivity(worker, nonce, "stepping", 0.5, 7),), (WorkerExit("w1", 2, "was killed by SIGKILL", True),)),
    ]


def to_worker(session: int, attempt: int = 1) -> list[ToWorker]:
    """What a learner may say in this session, to the worker that asked for it in this attempt."""
    return [
        Welcome(session, attempt, run_spec()),
        Refuse("no"),
        Rejoin(session),
        Describe(session, 1, EnvSpec("Fake-v0")),
        Weights(5, np.arange(5, dtype=np.float32), np.zeros(0, np.float32)),
        Collect(session, 0, (Permit(50, 0, 0, 0),), (Received(0, 0, 0, (1,)),), (0,)),
        Release(session, (LaneIncarnation(0, 0),)),
        HeartbeatReply(session, 1, (Received(0, 0, 0, ()),)),
        Drain("finished"),
        Evaluate(session, 63, 5, (1, 2), True, 100, False, False),
        Reset(session, 60, 0, 0, (0, 2), (7, None), PACKED),
        Step(session, 61, 0, 0, (np.ones((3, 2), np.int64),)),
        Call(session, 62, 0, 0, (1,), "gravity", True, PACKED),
    ]
