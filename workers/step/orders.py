"""The orders of a vector environment as a worker holds them. Pure: messages in, messages out.

The law: a ticket rises with every order of a lane; each is obeyed once. The answer is kept until the lane's next order, and
an order that is said again, because its answer was lost on the way, is answered again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.messages import Answer, LaneLife, Order


@dataclass
class _Seat:
    """A lane that lives here."""

    incarnation: int
    newest: int  # ticket
    order: Order | None  # not obeyed yet
    kept: Answer | None = None  # to the newest


class Orders:
    """What is to be done on each lane, and what came of it last."""

    def __init__(self) -> None:
        self._seats: dict[int, _Seat] = {}

    def take(self, order: Order) -> list[Answer]:
        """An order has arrived; the answers to be said again."""
        seat = self._seats.get(order.lane)
        if seat is None or order.incarnation > seat.incarnation or order.ticket > seat.newest:
            if seat is None or order.incarnation >= seat.incarnation:
                self._seats[order.lane] = _Seat(order.incarnation, order.ticket, order)
            return []
        return [seat.kept] if seat.kept is not None and seat.kept.ticket == order.ticket else []

    def next(self) -> Order | None:
        """The oldest order that is not obeyed yet."""
        waiting = [seat.order for seat in self._seats.values() if seat.order is not None]
        return min(waiting, key=lambda order: order.ticket, default=None)

    def obeyed(self, answer: Answer) -> bool:
        """Keep the answer; False if nobody waits for it any more."""
        seat = self._seats.get(answer.lane)
        if seat is None or seat.incarnation != answer.incarnation or seat.newest != answer.ticket:
            return False
        seat.order, seat.kept = None, answer
        return True

    def held(self) -> tuple[int, ...]:
        """Tickets of the orders that are not obeyed yet."""
        return tuple(seat.order.ticket for seat in self._seats.values() if seat.order is not None)

    def lives(self) -> tuple[LaneLife, ...]:
        """The lanes that live here."""
        return tuple(LaneLife(lane, seat.incarnation) for lane, seat in self._seats.items())

    def release(self, lives: Sequence[LaneLife]) -> list[LaneLife]:
        """Let go of these lanes; those of them that were here, in no later life."""
        gone = []
        for life in lives:
            seat = self._seats.get(life.lane)
            if seat is not None and seat.incarnation <= life.incarnation:
                del self._seats[life.lane]
                gone.append(LaneLife(life.lane, seat.incarnation))
        return gone
