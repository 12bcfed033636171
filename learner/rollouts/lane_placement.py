"""Which worker each lane lives with. Pure: no clock, no socket.

The law: every lane has an owner as long as there are workers, and no worker has two lanes more than another. A lane moves
only between its rollouts. What was placed is looked at again only when something has happened that can change it: with a
thousand workers, to look at all of them whenever a rollout comes would cost more than the rollout.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Sequence

from learner.members.membership import Member, Out
from learner.rollouts.lanes import Lane
from protocol.messages import LaneLife, Release


class Placing:
    """Lanes and their owners."""

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self._lanes = lanes
        self._homeless = list(lanes)
        self._settled = False
        self._awaited: Member | None = None  # a lane of this worker is to move, once its tickets have ended

    def joined(self) -> None:
        """There is one worker more."""
        self._settled = False

    def lost(self, member: Member) -> None:
        """There is one worker less: its lanes need another."""
        self._settled = False
        for number in member.lanes:
            self._lanes[number].restart()
            self._homeless.append(self._lanes[number])

    def ended(self, member: Member) -> None:
        """A ticket of this worker has ended."""
        if member is self._awaited:
            self._settled = False

    def place(self, active: Iterable[Member]) -> list[Out]:
        """Give lanes that have no owner to whoever has the fewest, and even out."""
        if self._settled:
            return []
        self._settled = True
        members = sorted(active, key=lambda member: member.order)
        self._house(members)
        return self._even_out(members)

    def _house(self, members: Sequence[Member]) -> None:
        emptiest = [(len(member.lanes), member.order, member) for member in members]
        heapq.heapify(emptiest)
        for lane in sorted(self._homeless, key=lambda lane: lane.number):
            has, order, member = emptiest[0]
            _give(lane, member)
            heapq.heapreplace(emptiest, (has + 1, order, member))
        self._homeless.clear()

    def _even_out(self, members: Sequence[Member]) -> list[Out]:
        for number in self._awaited.lanes if self._awaited is not None else ():
            self._lanes[number].moving = False
        self._awaited = None
        out: list[Out] = []
        while True:
            fullest = max(members, key=lambda member: len(member.lanes))
            emptiest = min(members, key=lambda member: len(member.lanes))
            if len(fullest.lanes) - len(emptiest.lanes) < 2:
                return out
            lane = min((self._lanes[n] for n in fullest.lanes), key=lambda lane: (len(lane.outstanding), -lane.number))
            if lane.outstanding:
                lane.moving, self._awaited = True, fullest
                return out
            fullest.lanes.remove(lane.number)
            out.append((fullest.peer, Release(fullest.session, (LaneLife(lane.number, lane.incarnation),))))
            lane.restart()
            _give(lane, emptiest)


def _give(lane: Lane, member: Member) -> None:
    lane.owner = member.peer
    member.lanes.add(lane.number)
