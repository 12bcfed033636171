"""The learner's interface to the worker processes that this program started."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from millrace.learner.members.events import Failed
from millrace.learner.members.member import Member
from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit


@dataclass(frozen=True)
class ProcessCallbacks:
    """The worker processes of this program; by default there are none."""

    ended: Callable[[], Iterable[WorkerExit | StartFailed]] = lambda: ()
    """Returns the workers whose processes have ended since the last call. It may raise."""
    running: Callable[[], Iterable[WorkerActivity]] = lambda: ()
    """Returns what the workers do whose processes run. A stopped process is left out."""
    said: Callable[[], Mapping[str, str]] = dict
    """Returns the last line that each of them wrote to its log, by the worker's name; what wrote nothing is left out."""
    left: Callable[[bool], float] = lambda collecting: math.inf
    """Returns how many workers run or will be started again; infinity if others may join. True: of those that collect."""
    count: Callable[[], int] | None = None
    """Returns the number of processes that step the environment. None: one per member."""
    lower_priority: Callable[[], None] = lambda: None
    """Gives these processes, and those that replace them, the lowest CPU priority."""
    stepping: Callable[[], list[Member]] = list
    """Returns the workers that step the environment, if the learner's members do not; else none."""
    failed: list[Failed] = field(default_factory=list)
    """Failures of those workers, which the learner takes out."""
    expected: int = 0
    """Number of processes that the user asked for. 0: any number."""
    most_copies: int = 0
    """The most env copies that their machine has room for. 0: any number."""
