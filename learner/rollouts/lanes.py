"""The coordinator's records of lanes, tickets and accepted rollouts, and the order in which lanes get tickets. Pure.

Rule: a lane has one owner at a time. A new owner starts it afresh: its incarnation rises, and its rollouts are counted
from 0 again.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field

from learner.members.lane_placement import PlacedLane
from protocol.rollout import Rollout


@dataclass
class TicketedLane(PlacedLane):
    """A lane on which workers collect rollouts."""

    progress: int = 0
    """Number of tickets used or outstanding."""
    started: bool = False
    """Whether a ticket of this incarnation was dealt."""
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
        if self.started:
            self.incarnation += 1
            self.started, self.next_sequence, self.out_of_order = False, 0, set()

    def expects(self, sequence: int) -> bool:
        """Whether an outstanding rollout can have this sequence number."""
        end = self.next_sequence + len(self.out_of_order) + len(self.outstanding)
        return self.next_sequence <= sequence < end and sequence not in self.out_of_order

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
    version: int
    """Version of the newest weights when the ticket was dealt."""
    peer: bytes


@dataclass(frozen=True, slots=True)
class AcceptedRollout:
    """A rollout that was accepted, with what the learner knows about it and its message does not carry."""

    rollout: Rollout
    incarnation: int
    """Incarnation of the lane when its ticket was dealt. Each incarnation has new env copies."""
    fresh: bool = True
    """Whether nothing carries over to it from an earlier rollout: it does not continue the one of its lane that was used
    last, because the lane was started anew, the learner was, or a rollout between the two was dropped or comes later."""


class LaneQueue:
    """Selects the lane for the next ticket: the least advanced; in a tie, the one with the lowest number.

    An entry of the heap may be out of date; then the heap also holds a newer one of the same lane.
    """

    def __init__(self, lanes: Sequence[TicketedLane]) -> None:
        self._lanes = lanes
        self._heap = [(lane.progress, lane.number) for lane in lanes]
        heapq.heapify(self._heap)

    def first(self) -> TicketedLane:
        """The least advanced lane."""
        while True:
            progress, number = self._heap[0]
            if self._lanes[number].progress == progress:
                return self._lanes[number]
            heapq.heappop(self._heap)

    def advance(self, lane: TicketedLane) -> None:
        """The lane was dealt a ticket."""
        self._move(lane, 1)

    def set_back(self, lane: TicketedLane) -> None:
        """Take back one advance: a ticket of the lane was lost, or its rollout was dropped."""
        self._move(lane, -1)

    def _move(self, lane: TicketedLane, by: int) -> None:
        lane.progress += by
        heapq.heappush(self._heap, (lane.progress, lane.number))
