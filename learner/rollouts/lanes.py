"""A lane, and a ticket, as the learner sees them, and whose turn it is. No clock, no messages.

The law: a lane has one owner at a time; whoever gets it starts it afresh: its incarnation rises, its rollouts are counted
from 0 again.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
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


class Turns:
    """Whose turn it is: the least advanced lane's; of equals, that of the lowest number.

    What an entry of the heap says of its lane may be out of date; then there is another one that is not.
    """

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self._lanes = lanes
        self._heap = [(lane.progress, lane.number) for lane in lanes]
        heapq.heapify(self._heap)

    def first(self) -> Lane:
        """The least advanced lane."""
        while True:
            progress, number = self._heap[0]
            if self._lanes[number].progress == progress:
                return self._lanes[number]
            heapq.heappop(self._heap)

    def forward(self, lane: Lane) -> None:
        """It was dealt a ticket."""
        self._moved(lane, 1)

    def back(self, lane: Lane) -> None:
        """One of its tickets came to nothing."""
        self._moved(lane, -1)

    def _moved(self, lane: Lane, by: int) -> None:
        lane.progress += by
        heapq.heappush(self._heap, (lane.progress, lane.number))
