"""The tickets that a worker holds and the rollouts that it keeps, lane by lane. Pure.

Rule: a ticket is collected once. Its rollout is kept until the learner has received it, and sent again when the learner
asks for it again. So a worker holds at most what the learner has outstanding, and its memory is bounded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from protocol.messages import LaneIncarnation, Permit, Received, Rollout

REMEMBERED_TICKETS = 64  # finished tickets of a lane, to recognize a late repeat of their Collect


@dataclass(frozen=True)
class Assignment:
    """One rollout to collect."""

    ticket: int
    lane: int
    incarnation: int
    """If the worker has another incarnation of the lane, the lane starts on new env copies."""
    sequence: int


@dataclass
class _HeldLane:
    """Tickets and rollouts that the worker holds for one lane."""

    incarnation: int
    sequence: int = 0  # of the next rollout
    tickets: dict[int, int] = field(default_factory=dict)  # ticket, not yet collected -> lowest version to collect it under
    kept: dict[int, Rollout] = field(default_factory=dict)  # ticket -> rollout that the learner may not have received
    finished: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED_TICKETS))


class HeldRollouts:
    """What a worker holds in one session: tickets whose rollouts are still to be collected, and rollouts that the learner
    has not confirmed.
    """

    def __init__(self) -> None:
        self._lanes: dict[int, _HeldLane] = {}

    def __len__(self) -> int:
        """Number of tickets and rollouts."""
        return sum(len(lane.tickets) + len(lane.kept) for lane in self._lanes.values())

    def take(self, permit: Permit, version: int) -> Rollout | None:
        """Take a ticket to collect under this version or a later one. Returns a rollout to send again, if any."""
        lane = self._lanes.get(permit.lane)
        if lane is None or permit.incarnation > lane.incarnation:
            lane = self._lanes[permit.lane] = _HeldLane(permit.incarnation)
        if permit.incarnation < lane.incarnation or permit.ticket in lane.tickets or permit.ticket in lane.finished:
            return None
        if permit.ticket in lane.kept:
            return lane.kept[permit.ticket]
        lane.tickets[permit.ticket] = version
        return None

    def startable(self, version: int) -> tuple[Assignment, ...]:
        """The oldest ticket of each lane that may be collected under this version, in the order of the lanes."""
        assignments = []
        for number, lane in sorted(self._lanes.items()):
            startable = [ticket for ticket, lowest in lane.tickets.items() if lowest <= version]
            if startable:
                assignments.append(Assignment(min(startable), number, lane.incarnation, lane.sequence))
        return tuple(assignments)

    def keep(self, rollout: Rollout) -> bool:
        """Keep a collected rollout; False if its lane was released, or its ticket withdrawn, in the meantime."""
        lane = self._lanes.get(rollout.lane)
        if lane is None or rollout.ticket not in lane.tickets:
            return False
        del lane.tickets[rollout.ticket]
        lane.kept[rollout.ticket] = rollout
        lane.sequence += 1
        return True

    def forget_received(self, received: Sequence[Received]) -> None:
        """Drop the rollouts that the learner has received."""
        for of_lane in received:
            lane = self._lanes.get(of_lane.lane)
            if lane is None or lane.incarnation != of_lane.incarnation:
                continue
            for ticket, rollout in list(lane.kept.items()):
                if rollout.sequence < of_lane.next_sequence or rollout.sequence in of_lane.out_of_order:
                    del lane.kept[ticket]
                    lane.finished.append(ticket)

    def tickets(self) -> tuple[int, ...]:
        """Tickets that are not yet collected."""
        return tuple(ticket for lane in self._lanes.values() for ticket in lane.tickets)

    def lanes(self) -> tuple[LaneIncarnation, ...]:
        """The lanes of this worker."""
        return tuple(LaneIncarnation(number, lane.incarnation) for number, lane in self._lanes.items())

    def release(self, lanes: Sequence[LaneIncarnation]) -> list[LaneIncarnation]:
        """Drop these lanes. Returns those that were here, in this or an earlier incarnation."""
        released = []
        for old in lanes:
            lane = self._lanes.get(old.lane)
            if lane is not None and lane.incarnation <= old.incarnation:
                del self._lanes[old.lane]
                released.append(LaneIncarnation(old.lane, lane.incarnation))
        return released
