"""A worker as the learner of a run sees it. Plain data."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from learner.members.membership import Member
from protocol.messages import WorkerStatus


@dataclass
class CollectingMember(Member):
    """A worker that collects rollouts and plays evaluations."""

    versions: dict[int, int] = field(default_factory=dict)
    """Versions that were sent to the worker, unless it is known to lack them; for each, `replies` when it was sent last."""
    strikes: int = 0
    """Number of the worker's rollouts and messages that could not be used."""

    def status(self, now: float) -> WorkerStatus:
        """The worker's row of `millrace status`."""
        held = () if self.heartbeat is None else self.heartbeat.versions
        return msgspec.structs.replace(super().status(now), version=max(held, default=-1), strikes=self.strikes)
