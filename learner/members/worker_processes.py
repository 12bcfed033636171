"""The learner's view of the worker processes that its program started: how they end, what they do, how many are left.

The code that starts them (`millrace/launch/`) overrides these methods. The class itself serves a learner whose workers are
all started elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from millrace.learner.members.events import Failed
from millrace.learner.members.member import Member
from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit


class WorkerProcesses:
    """The worker processes of a program that starts none. Workers may join from elsewhere."""

    expected: int = 0
    """The number of processes that the user asked for; 0 for any number."""
    most_copies: int = 0
    """The largest number of env copies for which this machine has room; 0 for any number."""

    def ended(self) -> Sequence[WorkerExit | StartFailed]:
        """The workers whose processes have ended since the last call. An override may raise."""
        return ()

    def activities(self) -> Sequence[WorkerActivity]:
        """What each running worker process is doing. Suspended processes are left out."""
        return ()

    def last_lines(self) -> Mapping[str, str]:
        """The last line of each worker's log, by the worker's name. Workers that have written nothing are left out."""
        return {}

    def left(self, *, collecting: bool) -> float:
        """How many processes are running or will be restarted; infinity if others may join.

        If `collecting`, processes that only evaluate don't count.
        """
        return math.inf

    def kill(self, worker: str) -> bool:
        """End the process of this worker at once. Returns False if the worker isn't one of these processes."""
        return False

    def stop(self, timeout_s: float) -> None:
        """Ask all processes to end, and kill those still running after `timeout_s`."""

    def lower_priority(self) -> None:
        """Give these processes, and those that replace them, the lowest CPU priority."""

    def stepping(self) -> Sequence[Member] | None:
        """The workers that step the environment, if these are not the learner's members; otherwise None."""
        return None

    def take_failures(self) -> Sequence[Failed]:
        """The failures, since the last call, of the workers that `stepping` returns."""
        return ()
