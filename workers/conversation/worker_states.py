"""A worker's states in the conversation, and a table of the next state, by state and message or event. Plain data."""

from __future__ import annotations

from enum import Enum

from millrace.protocol.messages import (
    Call,
    Collect,
    Describe,
    Drain,
    Evaluate,
    HeartbeatReply,
    Refuse,
    Rejoin,
    Release,
    Reset,
    Step,
    Weights,
    Welcome,
)


class WorkerState(Enum):
    """The state of a worker in the conversation."""

    JOINING = "joining"
    READY = "ready"
    DRAINING = "draining"
    LEFT = "left"


class LearnerSilent:
    """Event: the learner has sent nothing for `learner_timeout_s` after a Heartbeat, or, while joining, for too long."""


class StopRequested:
    """Event: this worker was asked to leave, for example by SIGTERM."""


class WorkFinished:
    """Event: a draining worker has finished its work in progress."""


class WorkerFailed:
    """Event: the environment, or this worker's own code, raised an exception."""


# The next state. A message that is not listed is ignored in that state (rules STAYS, REFUSE).
TABLE: dict[WorkerState, dict[type, WorkerState]] = {
    WorkerState.JOINING: {  # rule JOINING_IGNORES
        Welcome: WorkerState.READY,
        Refuse: WorkerState.LEFT,
        Drain: WorkerState.LEFT,  # rule DRAIN_JOINING
        LearnerSilent: WorkerState.LEFT,
        StopRequested: WorkerState.LEFT,
        WorkerFailed: WorkerState.LEFT,
    },
    WorkerState.READY: {
        Describe: WorkerState.READY,
        Weights: WorkerState.READY,
        Collect: WorkerState.READY,
        Evaluate: WorkerState.READY,
        Reset: WorkerState.READY,
        Step: WorkerState.READY,
        Call: WorkerState.READY,
        Release: WorkerState.READY,
        HeartbeatReply: WorkerState.READY,
        Welcome: WorkerState.READY,
        Rejoin: WorkerState.JOINING,  # rule REJOIN
        Refuse: WorkerState.LEFT,
        Drain: WorkerState.DRAINING,  # rule DRAIN
        LearnerSilent: WorkerState.JOINING,  # rule SILENT
        StopRequested: WorkerState.DRAINING,  # rule STOP
        WorkerFailed: WorkerState.LEFT,
    },
    WorkerState.DRAINING: {  # rule DRAINING_IGNORES
        Weights: WorkerState.DRAINING,  # if Heartbeats didn't list them, the learner would send them again
        HeartbeatReply: WorkerState.DRAINING,
        Rejoin: WorkerState.LEFT,  # rule DRAINING_LEAVES
        Refuse: WorkerState.LEFT,
        LearnerSilent: WorkerState.LEFT,
        StopRequested: WorkerState.LEFT,
        WorkFinished: WorkerState.LEFT,
        WorkerFailed: WorkerState.LEFT,
    },
    WorkerState.LEFT: {},
}
