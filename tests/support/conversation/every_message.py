"""A good message of each kind that a worker or a learner can send: what tests of every message go through.

Rule: the lists are complete, in the order of the document. A message that is not made here is as small as it may be.
"""

from __future__ import annotations

from typing import Any, get_args

import numpy as np

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import (
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
    Release,
    Reset,
    Returned,
    Rollout,
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
from tests.support.conversation.example_messages import example, example_of_session
from tests.support.conversation.fake_ends import fake_rollout, run_spec

PACKED = np.frombuffer(pack([(0, {"ünï": [1.5, "text"]})]), np.uint8)
BOX = BoxSpace((2,), "float32", np.full(2, -1, np.float32), np.ones((), np.float32))
BOXES = DictSpace(("a", "b"), (BOX, TupleSpace((MultiBinarySpace((3,)),))))


def to_learner(session: int, worker: str = "w0", nonce: int = 1) -> list[ToLearner]:
    """What this worker may say in this session."""
    of_copies = {
        "obs": (np.ones((2, 4)),),
        "reward": np.ones(2),
        "terminated": np.zeros(2, bool),
        "truncated": np.ones(2, bool),
    }
    description = EnvDescription(BOXES, DiscreteSpace(2, 0, "int64"), PACKED, "{}", 500, "human")
    said: dict[type, Any] = {
        Hello: example(Hello, worker=worker, process_nonce=nonce, attempt=nonce),
        Alive: Alive(
            (WorkerActivity(worker, nonce, "stepping", 0.5, 7),), (WorkerExit("w1", 2, "was killed by SIGKILL", True),)
        ),
        Rollout: fake_rollout(session, 0, 0, 0, 0),
        Heartbeat: example(Heartbeat, session=session, versions=(0,), tickets=(1, 2), steps=5, stages={"act": 0.1}),
        Goodbye: Goodbye(session, "told to stop", (1,)),
        Failure: example(Failure, session=session, error="ValueError: ünïcode", traceback="Traceback: …", lane=0),
        Described: Described(session, 1, description),
        EpisodeRows: example(
            EpisodeRows,
            session=session,
            ticket=1,
            obs=(np.ones((3, 4)),),
            action=np.ones(2),
            reward=np.ones(2),
            terminated=np.zeros(2, bool),
            truncated=np.ones(2, bool),
        ),
        Evaluated: example(Evaluated, session=session, ticket=1, episodes=(Episode(1.5, 2, 0.1),), cut=(False,)),
        Stepped: example(Stepped, session=session, ticket=1, **of_copies, infos=PACKED),
        Returned: example(Returned, session=session, ticket=1, results=PACKED, error="ValueError: ünïcode", traceback="…"),
    }
    return [said.get(kind) or example_of_session(kind, session) for kind in get_args(ToLearner)]


def to_worker(session: int, attempt: int = 1) -> list[ToWorker]:
    """What a learner may say in this session, to the worker that asked for it in this attempt."""
    said: dict[type, Any] = {
        Welcome: Welcome(session, attempt, run_spec()),
        Refuse: Refuse("no"),
        Describe: Describe(session, 1, EnvSpec("Fake-v0")),
        Weights: Weights(5, np.arange(5, dtype=np.float32), np.zeros(0, np.float32)),
        Collect: example(
            Collect,
            session=session,
            permits=(example(Permit, ticket=50),),
            received=(Received(0, 0, 0, (1,)),),
            keep=(0,),
        ),
        Release: Release(session, (LaneIncarnation(0, 0),)),
        HeartbeatReply: HeartbeatReply(session, 1, (Received(0, 0, 0, ()),)),
        Drain: Drain("finished"),
        Evaluate: example(Evaluate, session=session, ticket=63, version=5, seeds=(1, 2), greedy=True),
        Reset: example(Reset, session=session, ticket=60, copies=(0, 2), seeds=(7, None), options=PACKED),
        Step: example(Step, session=session, ticket=61, actions=(np.ones((3, 2), np.int64),)),
        Call: example(Call, session=session, ticket=62, copies=(1,), name="gravity", assign=True, given=PACKED),
    }
    return [said.get(kind) or example_of_session(kind, session) for kind in get_args(ToWorker)]
