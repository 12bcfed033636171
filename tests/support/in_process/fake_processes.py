"""Worker processes of a program whose workers are played by the test."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from millrace.learner.members.member import Member
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit


def _any_number(collecting: bool) -> float:
    return math.inf


@dataclass
class FakeProcesses(WorkerProcesses):
    """What each method returns."""

    expected: int = 0
    most_copies: int = 0
    of_ended: Callable[[], Sequence[WorkerExit | StartFailed]] = tuple
    of_activities: Callable[[], Sequence[WorkerActivity]] = tuple
    of_last_lines: Mapping[str, str] = field(default_factory=dict)
    of_left: Callable[[bool], float] = _any_number
    of_stepping: Callable[[], Sequence[Member]] | None = None

    def ended(self) -> Sequence[WorkerExit | StartFailed]:
        return self.of_ended()

    def activities(self) -> Sequence[WorkerActivity]:
        return self.of_activities()

    def last_lines(self) -> Mapping[str, str]:
        return self.of_last_lines

    def left(self, *, collecting: bool) -> float:
        return self.of_left(collecting)

    def stepping(self) -> Sequence[Member] | None:
        return None if self.of_stepping is None else self.of_stepping()
