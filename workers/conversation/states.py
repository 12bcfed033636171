"""State machine of a worker, as a table: the next state for each state and each message or event. Plain data."""

from __future__ import annotations

from enum import Enum

from protocol.messages import (
    Call,
    Collect,
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


class State(Enum):
    """State of a worker in the conversation."""

    JOINING = "joining"
    READY = "ready"
    DRAINING = "draining"
    LEFT = "left"


class LearnerSilent:
    """Event: no message of the learner followed a Heartbeat for `learner_timeout_s` (or, while joining, for too long)."""


class StopRequested:
    """Event: this worker was asked to leave, for example by SIGTERM."""


class WorkFinished:
    """Event: a draining worker has finished its work in progress."""


class WorkerFailed:
    """Event: the environment, or this worker, raised."""


# The next state. A message that is not listed is ignored in that state.
TABLE: dict[State, dict[type, State]] = {
    State.JOINING: {
        Welcome: State.READY,
        Refuse: State.LEFT,
        Drain: State.LEFT,
        LearnerSilent: State.LEFT,
        StopRequested: State.LEFT,
        WorkerFailed: State.LEFT,
    },
    State.READY: {
        Weights: State.READY,
        Collect: State.READY,
        Evaluate: State.READY,
        Reset: State.READY,
        Step: State.READY,
        Call: State.READY,
        Release: State.READY,
        HeartbeatReply: State.READY,
        Welcome: State.READY,
        Rejoin: State.JOINING,
        Refuse: State.LEFT,
        Drain: State.DRAINING,
        LearnerSilent: State.JOINING,
        StopRequested: State.DRAINING,
        WorkerFailed: State.LEFT,
    },
    State.DRAINING: {
        Weights: State.DRAINING,
        HeartbeatReply: State.DRAINING,
        Rejoin: State.LEFT,
        Refuse: State.LEFT,
        LearnerSilent: State.LEFT,
        StopRequested: State.LEFT,
        WorkFinished: State.LEFT,
        WorkerFailed: State.LEFT,
    },
    State.LEFT: {},
}
