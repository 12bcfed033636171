"""A rollout on the learner's side, with what the learner knows about it and the wire does not carry. Plain data."""

from __future__ import annotations

from dataclasses import dataclass

from protocol.rollout import Rollout


@dataclass(frozen=True, slots=True)
class AcceptedRollout:
    """A rollout that was accepted."""

    rollout: Rollout
    incarnation: int
    """Incarnation of the lane when its ticket was dealt. Each incarnation has new env copies."""
