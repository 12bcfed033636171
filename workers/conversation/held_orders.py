"""The orders (Reset, Step, Call) of a vector environment that a worker holds, lane by lane. Pure: messages in, messages out.

Rule: tickets rise with every order of a lane, and each order is executed once. The answer is kept until the lane's next
order. When an order arrives again, because its answer was lost, the same answer is sent again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.messages import Answer, LaneIncarnation, Order


@dataclass
class _HeldLane:
    """Orders that the worker holds for one lane."""

    incarnation: int
    newest: int  # highest ticket
    order: Order | None  # not yet executed
    answer: Answer | None = None  # to the newest order


class HeldOrders:
    """Orders to execute and answers to keep, of all lanes of a worker in one session."""

    def __init__(self) -> None:
        self._lanes: dict[int, _HeldLane] = {}

    def take(self, order: Order) -> Answer | None:
        """Take an order that has arrived. Returns an answer to send again, if any."""
        lane = self._lanes.get(order.lane)
        if lane is None or order.incarnation > lane.incarnation or order.ticket > lane.newest:
            if lane is None or order.incarnation >= lane.incarnation:
                self._lanes[order.lane] = _HeldLane(order.incarnation, order.ticket, order)
            return None
        return lane.answer if lane.answer is not None and lane.answer.ticket == order.ticket else None

    def next(self) -> Order | None:
        """The oldest order that is not yet executed."""
        waiting = [lane.order for lane in self._lanes.values() if lane.order is not None]
        return min(waiting, key=lambda order: order.ticket, default=None)

    def keep(self, answer: Answer) -> bool:
        """Keep the answer to an executed order; False if its lane was released, or has a newer order, in the meantime."""
        lane = self._lanes.get(answer.lane)
        if lane is None or lane.incarnation != answer.incarnation or lane.newest != answer.ticket:
            return False
        lane.order, lane.answer = None, answer
        return True

    def tickets(self) -> tuple[int, ...]:
        """Tickets of the orders that are not yet executed."""
        return tuple(lane.order.ticket for lane in self._lanes.values() if lane.order is not None)

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
