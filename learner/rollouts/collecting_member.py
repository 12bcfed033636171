"""A worker that collects rollouts, as the learner of a run sees it. Plain data."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from millrace.learner.members.member import Member
from millrace.protocol.messages import Heartbeat, WorkerStatus


@dataclass
class CollectingMember(Member):
    """A worker that collects rollouts and plays evaluations."""

    strikes: int = 0
    """The number of the worker's rollouts and messages that could not be used."""
    ended_steps: int = 0
    """The env steps that its process made before this session, plus those in its rollouts and evaluations that arrived."""

    @property
    def steps_under_way(self) -> int:
        """The env steps that were made for its unfinished tickets, as of its newest heartbeat."""
        return 0 if self.heartbeat is None else max(0, self.heartbeat.steps - self.ended_steps)

    def record_heartbeat(self, heartbeat: Heartbeat) -> list[int]:
        """Record a heartbeat. Returns the tickets that were lost on the way to the worker."""
        if self.has_counted or not heartbeat.tickets:  # the worker has no unfinished work of this session
            self.ended_steps = heartbeat.steps
        return super().record_heartbeat(heartbeat)

    def status(self, now: float) -> WorkerStatus:
        """The worker's row of `millrace status`."""
        held = () if self.heartbeat is None else self.heartbeat.versions
        return msgspec.structs.replace(super().status(now), version=max(held, default=-1), strikes=self.strikes)
