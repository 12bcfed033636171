"""The worker processes that this program started, as its learner knows them: how they end, what they do, how many are left.

The code that starts them (`millrace/launch/`) overrides these methods. The class itself is for a learner whose workers are
all started elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from millrace.learner.members.events import Failed
from millrace.learner.members.member import Member
from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit


class WorkerProcesses:
    """No processes of this program: workers may join from elsewhere."""

    expected: int = 0
    """Number of processes that the user asked for. 0: any number."""
    most_copies: int = 0
    """The largest number of env copies that their machine has room for. 0: any number."""

    def ended(self) -> Sequence[WorkerExit | StartFailed]:
        """The workers whose processes have ended since the last call. It may raise."""
        return ()

    def activities(self) -> Sequence[WorkerActivity]:
        """What the workers with running processes are doing. A stopped process is left out."""
        return ()

    def last_lines(self) -> Mapping[str, str]:
        """The last line of each worker's log, by the worker's name, without workers that have written nothing."""
        return {}

    def left(self, *, collecting: bool) -> float:
        """How many run or will be restarted; infinity if others may join. `collecting`: count only those that collect."""
        return math.inf

    def kill(self, worker: str) -> bool:
        """End the process of this worker at once; False if it isn't one of these."""
        return False

    def stop(self, timeout_s: float) -> None:
        """Ask all to leave, and kill those that still run after `timeout_s`."""

    def lower_priority(self) -> None:
        """Give these processes, and those that replace them, the lowest CPU priority."""

    def stepping(self) -> Sequence[Member] | None:
        """The workers that step the environment, if these are not the learner's members; else None."""
        return None

    def take_failures(self) -> Sequence[Failed]:
        """Failures of those workers, since the last call."""
        return ()
