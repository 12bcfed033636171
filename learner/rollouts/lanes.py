"""The coordinator's records of lanes and tickets. Pure.

Rule: a lane has one owner at a time. A new owner starts it afresh: its incarnation rises, and its rollouts are counted
from 0 again.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from millrace.learner.members.lane_placement import PlacedLane


@dataclass
class TicketedLane(PlacedLane):
    """A lane on which workers collect rollouts."""

    due: list[int] = field(default_factory=list)
    """Open rounds without a ticket, in order."""
    dealt: int = 0
    """Number of tickets of this incarnation that were dealt: the sequence number of the next rollout."""
    outstanding: set[int] = field(default_factory=set)
    """Tickets that the lane's worker holds."""
    next_sequence: int = 0
    """Every rollout of this incarnation with a smaller sequence number has arrived."""
    out_of_order: set[int] = field(default_factory=set)
    """Sequence numbers that have arrived out of order."""
    newest_used: tuple[int, int] | None = None
    """Incarnation and sequence number of the rollout that an update used last; None: none since the learner began."""

    @property
    def busy(self) -> int:
        """Number of its tickets that its worker holds."""
        return len(self.outstanding)

    def restart(self) -> None:
        """The lane left its worker. Its incarnation rises only if a ticket of this one was dealt."""
        super().restart()
        if self.dealt:
            self.incarnation += 1
            self.dealt = 0
            self.next_sequence = 0
            self.out_of_order = set()

    def deal(self, number: int, round_number: int, version: int, opponent: int | None) -> Ticket:
        """A ticket for the next rollout, for the lane's owner."""
        assert self.owner is not None
        ticket = Ticket(number, self.number, self.incarnation, self.dealt, round_number, version, self.owner, opponent)
        self.outstanding.add(number)
        self.dealt += 1
        return ticket

    def use(self, incarnation: int, sequence: int) -> bool:
        """An update uses this rollout. Returns whether it continues the one that was used before it."""
        continues = self.newest_used == (incarnation, sequence - 1)
        self.newest_used = (incarnation, sequence)
        return continues

    def arrived(self, sequence: int) -> None:
        """The rollout with this sequence number has arrived."""
        self.out_of_order.add(sequence)
        while self.next_sequence in self.out_of_order:
            self.out_of_order.remove(self.next_sequence)
            self.next_sequence += 1


@dataclass(frozen=True)
class Ticket:
    """A ticket that is with a worker."""

    number: int
    lane: int
    incarnation: int
    sequence: int
    """Number of its rollout in this incarnation."""
    round: int
    version: int
    """Version of the weights that act."""
    peer: bytes
    opponent: int | None = None
    """As in a `Permit`."""
