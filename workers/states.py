"""Where a worker stands in the conversation, as a table: what each message, or event, makes of each state. Plain data."""

from __future__ import annotations

from enum import Enum

from protocol.messages import (
    Call,
    Collect,
    Drain,
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
    """Where a worker stands."""

    JOINING = "joining"
    READY = "ready"
    DRAINING = "draining"
    LEFT = "left"


class Silence:
    """Event: the learner has said nothing for `learner_timeout_s` (or, while joining, for too long)."""


class Terminate:
    """Event: this worker was asked to leave (SIGTERM)."""


class Emptied:
    """Event: nothing is in hand any more."""


class Broke:
    """Event: the environment, or this worker, raised."""


# What each state becomes; a message that is not listed is ignored in that state.
TABLE: dict[State, dict[type, State]] = {
    State.JOINING: {
        Welcome: State.READY,
        Refuse: State.LEFT,
        Drain: State.LEFT,
        Silence: State.LEFT,
        Terminate: State.LEFT,
        Broke: State.LEFT,
    },
    State.READY: {
        Weights: State.READY,
        Collect: State.READY,
        Reset: State.READY,
        Step: State.READY,
        Call: State.READY,
        Release: State.READY,
        HeartbeatReply: State.READY,
        Welcome: State.READY,
        Rejoin: State.JOINING,
        Refuse: State.LEFT,
        Drain: State.DRAINING,
        Silence: State.JOINING,
        Terminate: State.DRAINING,
        Broke: State.LEFT,
    },
    State.DRAINING: {
        Weights: State.DRAINING,
        HeartbeatReply: State.DRAINING,
        Rejoin: State.LEFT,
        Refuse: State.LEFT,
        Silence: State.LEFT,
        Terminate: State.LEFT,
        Emptied: State.LEFT,
        Broke: State.LEFT,
    },
    State.LEFT: {},
}
