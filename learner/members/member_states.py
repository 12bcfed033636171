"""The states of a worker as the learner sees them, and the table of the transitions that messages and events cause."""

from __future__ import annotations

from enum import Enum

from millrace.protocol.messages import (
    Alive,
    Described,
    Drain,
    EpisodeRows,
    Evaluated,
    Failure,
    Goodbye,
    Heartbeat,
    Hello,
    Returned,
    Rollout,
    Stepped,
)


class MemberState(Enum):
    """The state of a worker, as the learner sees it."""

    UNKNOWN = "unknown"
    ACTIVE = "active"
    DRAINING = "draining"


class TimedOut:
    """Event: the worker was silent for `worker_timeout_s`, or its process is known to be dead."""


class SentUnusable:
    """Event: the worker sent too much that could not be used."""


class KeyRevoked:
    """Event: the worker's key may no longer connect."""


# The next state for each message or event. The learner itself sends Drain. Other messages from an unknown worker are
# answered with Rejoin.
TABLE: dict[MemberState, dict[type, MemberState]] = {
    MemberState.UNKNOWN: {Hello: MemberState.ACTIVE},
    MemberState.ACTIVE: {
        Hello: MemberState.ACTIVE,
        Alive: MemberState.ACTIVE,
        Described: MemberState.ACTIVE,
        Rollout: MemberState.ACTIVE,
        Heartbeat: MemberState.ACTIVE,
        EpisodeRows: MemberState.ACTIVE,
        Evaluated: MemberState.ACTIVE,
        Stepped: MemberState.ACTIVE,
        Returned: MemberState.ACTIVE,
        Goodbye: MemberState.UNKNOWN,
        Failure: MemberState.UNKNOWN,
        TimedOut: MemberState.UNKNOWN,
        SentUnusable: MemberState.UNKNOWN,
        KeyRevoked: MemberState.UNKNOWN,
        Drain: MemberState.DRAINING,
    },
    MemberState.DRAINING: {
        Alive: MemberState.DRAINING,
        Described: MemberState.DRAINING,
        Rollout: MemberState.DRAINING,
        Heartbeat: MemberState.DRAINING,
        EpisodeRows: MemberState.DRAINING,
        Evaluated: MemberState.DRAINING,
        Stepped: MemberState.DRAINING,
        Returned: MemberState.DRAINING,
        Goodbye: MemberState.UNKNOWN,
        Failure: MemberState.UNKNOWN,
        TimedOut: MemberState.UNKNOWN,
        SentUnusable: MemberState.UNKNOWN,
        KeyRevoked: MemberState.UNKNOWN,
    },
}
