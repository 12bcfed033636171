"""A lane, and a ticket, as the learner sees them. No clock, no messages.

The law: a lane has one owner at a time; whoever gets it starts it afresh: its incarnation rises, its rollouts are counted
from 0 again.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Lane:
    """A lane as the learner sees it."""

    number: int
    incarnation: int = 0
    owner: bytes | None = None
    progress: int = 0  # tickets used or outstanding
    started: bool = False  # a ticket of this incarnation was dealt
    moving: bool = False  # it waits for its last tickets to end before it moves to another worker
    outstanding: set[int] = field(default_factory=set)
    below: int = 0  # every rollout of this incarnation below this sequence has arrived
    ahead: set[int] = field(default_factory=set)  # sequences that have arrived out of order

    def restart(self) -> None:
        """A new life: on new env copies."""
        self.owner, self.moving = None, False
        if self.started:
            self.incarnation += 1
            self.started, self.below, self.ahead = False, 0, set()

    def awaits(self, sequence: int) -> bool:
        """Whether an outstanding rollout can have this sequence."""
        return self.below <= sequence < self.below + len(self.ahead) + len(self.outstanding) and sequence not in self.ahead

    def arrived(self, sequence: int) -> None:
        """Take note of a rollout."""
        self.ahead.add(sequence)
        while self.below in self.ahead:
            self.ahead.remove(self.below)
            self.below += 1


@dataclass(frozen=True)
class Ticket:
    """A ticket that is with a worker."""

    number: int
    lane: int
    incarnation: int
    version: int
    peer: bytes
