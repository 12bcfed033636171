"""A supervisor's reports about its workers. Imports neither numpy nor gymnasium, because a supervisor needs neither."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
from msgspec import Meta

from millrace.protocol.bounds import MAX_WORKERS, Line, Name, Natural, Seconds
from millrace.protocol.call_timeouts import Doing
from millrace.protocol.message_base import Message

SHARED_VERSIONS = 4  # how many of the newest versions a supervisor keeps in shared memory for its workers
# If a worker leaves because no slot is free, its reason begins with these words. The learner looks for them, because such a
# worker comes back when there is a slot.
NO_SLOT = "no slot is free"


class WorkerActivity(msgspec.Struct, frozen=True, array_like=True):
    """A running worker, as its supervisor sees it."""

    worker: Name
    process_nonce: Natural
    doing: Doing
    for_s: Seconds
    """seconds since it started this activity"""
    env_calls: Natural
    """calls to the environment (make, reset, step) that have returned since the worker started"""


class WorkerExit(msgspec.Struct, frozen=True, array_like=True):
    """A worker whose process has ended."""

    worker: Name
    process_nonce: Natural
    reason: Line
    """how it ended: an exit code, a signal, or the name of the timeout flag that its supervisor enforced"""
    failed: bool
    """whether the environment, the policy, or the worker is to blame for the worker's end"""
    of_policy: bool = False
    """whether it failed in a call to a user-defined policy, in which case no environment is to blame"""
    hung: bool = False
    """whether its supervisor ended it because a call took too long; its steps are then not replayed"""


@dataclass(frozen=True)
class StartFailed:
    """A worker's process that ended by itself before it had joined a run. Only its supervisor can say why, because the
    learner has never heard of it.
    """

    worker: str
    reason: str
    """one line: how it ended, and whether it is restarted"""
    last_lines: str
    """the last lines of its output; empty if it has written nothing, or has no log"""


class Alive(Message, frozen=True):
    """A supervisor reports which of its workers are running, and which have ended.

    The learner believes what a report says about a worker if the report contains the worker's `process_nonce` and comes from
    a peer with the worker's key. Once the run is over, the learner answers with `Drain`, and the supervisor ends the workers
    that don't leave by themselves.
    """

    running: Annotated[tuple[WorkerActivity, ...], Meta(max_length=MAX_WORKERS)]
    ended: Annotated[tuple[WorkerExit, ...], Meta(max_length=MAX_WORKERS)]
    """workers that ended recently; several reports name each of them, because a message may be lost"""
    replies: Natural | None = None
    """number of the last HeartbeatReply that the supervisor received, if its workers share the weights that it gets; null if
    they don't
    """
