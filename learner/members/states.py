"""Where the learner sees a worker stand, as a table: what each message, or event, makes of each standing. Plain data."""

from __future__ import annotations

from enum import Enum

from protocol.messages import Drain, Failure, Goodbye, Heartbeat, Hello, Returned, Rollout, Stepped


class Standing(Enum):
    """Where the learner sees a worker."""

    UNKNOWN = "unknown"
    ACTIVE = "active"
    DRAINING = "draining"


class Silence:
    """Event: nothing was heard of the worker for `worker_timeout_s`, or its process is known to be dead."""


class Rubbish:
    """Event: it sent too much that could not be used."""


class Revoked:
    """Event: the key under which it speaks may connect no more."""


# What each standing becomes; Drain is what the learner says. What an unknown worker says otherwise is answered by Rejoin.
TABLE: dict[Standing, dict[type, Standing]] = {
    Standing.UNKNOWN: {Hello: Standing.ACTIVE},
    Standing.ACTIVE: {
        Hello: Standing.ACTIVE,
        Rollout: Standing.ACTIVE,
        Heartbeat: Standing.ACTIVE,
        Stepped: Standing.ACTIVE,
        Returned: Standing.ACTIVE,
        Goodbye: Standing.UNKNOWN,
        Failure: Standing.UNKNOWN,
        Silence: Standing.UNKNOWN,
        Rubbish: Standing.UNKNOWN,
        Revoked: Standing.UNKNOWN,
        Drain: Standing.DRAINING,
    },
    Standing.DRAINING: {
        Rollout: Standing.DRAINING,
        Heartbeat: Standing.DRAINING,
        Stepped: Standing.DRAINING,
        Returned: Standing.DRAINING,
        Goodbye: Standing.UNKNOWN,
        Failure: Standing.UNKNOWN,
        Silence: Standing.UNKNOWN,
        Rubbish: Standing.UNKNOWN,
        Revoked: Standing.UNKNOWN,
    },
}
