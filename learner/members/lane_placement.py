"""Assignment of lanes to workers. Pure: no clock, no socket.

Rule: every lane has an owner as long as there are workers, and the lane counts of any two workers differ by at most one.
Workers that only evaluate, or that are still describing an environment, have no lanes. A lane moves only between its
rollouts. The placement is recomputed only after an event that can change it, because with a thousand workers, checking all
of them at each rollout would take longer than the rollout.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from millrace.learner.members.member import Member
from millrace.learner.members.membership import Outgoing
from millrace.protocol.messages import LaneIncarnation, Release


@dataclass
class PlacedLane:
    """A lane as the learner sees it: which worker has it, and how many times it has been started."""

    number: int
    incarnation: int = 0
    """Incremented when the lane starts again on new env copies."""
    owner: bytes | None = None
    """Routing id of the lane's worker; None if no worker has the lane."""
    moving: bool = False
    """Whether the lane will move to another worker once its last tickets have ended."""

    @property
    def busy(self) -> int:
        """How many of the lane's tickets its worker holds. A lane moves only if its worker holds none."""
        return 0

    def restart(self) -> None:
        """Record that the lane left its worker. Its next owner starts it on new env copies."""
        self.owner = None
        self.moving = False


L = TypeVar("L", bound=PlacedLane)


def is_spare(member: Member, lanes: Iterable[PlacedLane]) -> bool:
    """Whether the run doesn't need this worker: it has no lane, and every lane has a worker.

    A worker that only evaluates is needed while it plays an evaluation.
    """
    if member.hello.evaluates and not member.lanes:
        return not member.tickets
    return not member.lanes and all(lane.owner is not None for lane in lanes)


class LanePlacement(Generic[L]):
    """Assigns lanes to workers."""

    def __init__(self, lanes: Sequence[L], tie_break: Callable[[Member], Any]) -> None:
        """Among workers with equally few lanes, the one with the smallest `tie_break` gets the next lane."""
        self._lanes = lanes
        self._tie_break = tie_break
        self._unplaced = {lane.number for lane in lanes}
        self._settled = False
        self._waiting_for: Member | None = None  # the worker whose lane moves away once the lane's tickets have ended

    def joined(self) -> None:
        """Record that a worker joined."""
        self._settled = False

    def removed(self, member: Member) -> None:
        """Record that a worker was removed, so its lanes need another owner."""
        self._settled = False
        for number in member.lanes:
            self._lanes[number].restart()
        self._unplaced |= member.lanes

    def ticket_ended(self, member: Member) -> None:
        """Record that a ticket of this worker has ended."""
        if member is self._waiting_for:
            self._settled = False

    def place(self, active: Iterable[Member]) -> list[Outgoing]:
        """Assign all lanes that have no owner, then even out. Does nothing if nothing has changed."""
        if self._settled:
            return []
        self._settled = True
        if not self._unplaced and len({lane.owner for lane in self._lanes}) == len(self._lanes):
            self._stop_waiting()
            return []  # every lane has a worker of its own, so nothing moves, however many spare workers there are
        may_have_lanes = (each for each in active if not (each.hello.evaluates or each.describes))
        members = sorted(may_have_lanes, key=lambda member: member.join_number)
        if members:
            self.assign([self._lanes[number] for number in sorted(self._unplaced)], members)
        return self._even_out(members)

    def assign(self, lanes: Iterable[L], members: Iterable[Member]) -> None:
        """Give each of these lanes to the worker that has the fewest lanes at that point."""
        fewest_first = [(len(member.lanes), self._tie_break(member), n, member) for n, member in enumerate(members)]
        heapq.heapify(fewest_first)
        for lane in lanes:
            count, tie_break, n, member = fewest_first[0]
            self._give(lane, member)
            heapq.heapreplace(fewest_first, (count + 1, tie_break, n, member))

    def _even_out(self, members: Sequence[Member]) -> list[Outgoing]:
        """Move lanes from the workers with the most to those with the fewest, until one must wait for its tickets to end."""
        self._stop_waiting()
        out: list[Outgoing] = []
        while members:
            fullest = max(members, key=lambda member: len(member.lanes))
            emptiest = min(members, key=lambda member: (len(member.lanes), self._tie_break(member)))
            if len(fullest.lanes) - len(emptiest.lanes) < 2:
                break
            lane = min((self._lanes[n] for n in fullest.lanes), key=lambda lane: (lane.busy, -lane.number))
            if lane.busy:
                lane.moving = True
                self._waiting_for = fullest
                break
            fullest.lanes.remove(lane.number)
            out.append((fullest.peer, Release(fullest.session, (LaneIncarnation(lane.number, lane.incarnation),))))
            lane.restart()
            self._give(lane, emptiest)
        return out

    def _stop_waiting(self) -> None:
        for number in self._waiting_for.lanes if self._waiting_for is not None else ():
            self._lanes[number].moving = False
        self._waiting_for = None

    def _give(self, lane: L, member: Member) -> None:
        self._unplaced.discard(lane.number)
        lane.owner = member.peer
        member.lanes.add(lane.number)
