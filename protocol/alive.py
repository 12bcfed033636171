"""What a supervisor says about its workers. This file imports neither numpy nor gymnasium: a supervisor needs neither."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from millrace.protocol.bounds import MAX_WORKERS, Line, Name, Natural, Seconds
from millrace.protocol.message_base import Message

Doing = Literal[
    "starting", "waiting", "describing", "making", "preparing", "resetting", "stepping", "acting", "evaluating", "closing"
]
"""What a worker does, as its supervisor sees it. Code of the user runs in all of these except `starting` and `waiting`.

`making`: an env copy. `preparing`: a policy, with all that it imports. `acting`: a call of a policy that is the user's code.
"""
SHARED_VERSIONS = 4  # so many of the last weights that came to it, a supervisor keeps for its workers
NO_SLOT = "no slot is free"  # the beginning of the reason of a worker that leaves, and comes back when there is room
CLOSE_S = 10.0  # for one env copy; what hangs in `close` has done its work
OUR_CODE: frozenset[Doing] = frozenset({"starting", "waiting"})
OF_POLICY: frozenset[Doing] = frozenset({"preparing", "acting"})
CALLS: dict[Doing, str] = {
    "describing": "the construction of its environment",
    "making": "the construction of its environment",
    "preparing": "the construction of the policy",
    "resetting": "a reset of its environment",
    "stepping": "a step of its environment",
    "acting": "a call of the policy",
    "evaluating": "a step of an evaluation",
    "closing": "close() of its environment",
}
"""The calls of code of the user, for the reasons why a worker ended."""


class WorkerActivity(msgspec.Struct, frozen=True, array_like=True):
    """A running worker, as its supervisor sees it."""

    worker: Name
    process_nonce: Natural
    doing: Doing
    for_s: Seconds
    """seconds since it started to do this"""
    env_calls: Natural
    """calls of the environment (make, reset, step) that have returned since the worker started"""


class WorkerExit(msgspec.Struct, frozen=True, array_like=True):
    """A worker whose process has ended."""

    worker: Name
    process_nonce: Natural
    reason: Line
    """how it ended: an exit code, a signal, or a timeout that its supervisor enforced, by the name of its flag"""
    failed: bool
    """whether the environment, the policy, or the worker is to blame: it did not leave on purpose"""
    of_policy: bool = False
    """it failed in a call of a policy that the user wrote; no environment is to blame"""


@dataclass(frozen=True)
class StartFailed:
    """A worker's process that ended by itself before it had joined a run. Only its supervisor can say why, and only here:
    the learner has never heard of it.
    """

    worker: str
    reason: str
    """one line: how it ended, and whether it is started again"""
    last_lines: str
    """what it wrote last; empty if it has written nothing, or has no log"""


class Alive(Message, frozen=True):
    """A supervisor speaks for its workers. It is believed if it knows a worker's `process_nonce` and uses the same key.

    Once the run is over, it is answered by `Drain`: the supervisor then ends workers that do not leave by themselves.
    """

    running: Annotated[tuple[WorkerActivity, ...], Meta(max_length=MAX_WORKERS)]
    ended: Annotated[tuple[WorkerExit, ...], Meta(max_length=MAX_WORKERS)]
    """those that ended a short while ago; repeated, because a message may be lost"""
    replies: Natural | None = None
    """number of the last HeartbeatReply that came to the supervisor, if its workers share the weights that it gets; null if
    they do not"""


class CallTimeouts(msgspec.Struct, frozen=True):
    """How many seconds one call of the user's code may take before the supervisor ends its worker. 0: any time.

    The fields are named as the flags are.
    """

    start_s: float = 600.0
    """making or resetting an env copy, or making the policy"""
    step_s: float = 600.0
    """a step of an env copy, or a call of a policy that the user wrote"""

    def limit_s(self, doing: Doing) -> float:
        """The limit of what a worker does; infinite if it has none."""
        match doing:
            case "describing" | "making" | "preparing" | "resetting":
                limit = self.start_s
            case "stepping" | "acting" | "evaluating":
                limit = self.step_s
            case "closing":
                limit = CLOSE_S
            case "starting" | "waiting":
                limit = 0.0
        return limit or float("inf")

    def longest_s(self) -> float:
        """The longest time that a call may take; infinite if one of them may take any time."""
        return max(self.limit_s("making"), self.limit_s("stepping"))

    def reason(self, doing: Doing) -> str:
        """Why a worker is ended that exceeds its limit. The line names the flag."""
        flag = "step" if doing in ("stepping", "acting", "evaluating") else "start"
        named = f" (--{flag}-timeout-s)" if doing != "closing" else ""
        return f"was ended: {CALLS[doing]} took longer than {self.limit_s(doing):g} s{named}"
