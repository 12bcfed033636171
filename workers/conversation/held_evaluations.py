"""The Evaluate orders that a worker holds. Pure: messages in, messages out.

Rule: an order is executed once, under exactly the version of weights that it names. Its answer is kept, and sent again when
the order arrives again, because the answer was lost. An order whose rows were sent too is executed again instead: rows are
large, and the episodes are the same.
"""

from __future__ import annotations

from protocol.messages import Evaluate, Evaluated

KEPT_ANSWERS = 8  # a learner gives a worker at most two orders at a time, so only its last two answers can be missing


class HeldEvaluations:
    """Orders to execute and answers to keep, of one session."""

    def __init__(self) -> None:
        self._orders: dict[int, Evaluate] = {}  # by ticket, not yet executed
        self._answers: dict[int, Evaluated] = {}  # by ticket, oldest first

    def take(self, order: Evaluate) -> Evaluated | None:
        """Take an order that has arrived. Returns an answer to send again, if any."""
        if order.ticket in self._answers:
            return self._answers[order.ticket]
        self._orders.setdefault(order.ticket, order)
        return None

    def next(self, version: int) -> Evaluate | None:
        """The oldest order of this version, which is that of the weights held. Orders of older versions are dropped."""
        self._orders = {ticket: order for ticket, order in self._orders.items() if order.version >= version}
        due = [ticket for ticket, order in self._orders.items() if order.version == version]
        return self._orders[min(due)] if due else None

    def keep(self, answer: Evaluated) -> bool:
        """Keep the answer to an executed order; False if the order is no longer here."""
        order = self._orders.pop(answer.ticket, None)
        if order is None:
            return False
        if not (order.send_rows or order.send_frames):
            self._answers[answer.ticket] = answer
            if len(self._answers) > KEPT_ANSWERS:
                del self._answers[next(iter(self._answers))]
        return True

    def tickets(self) -> tuple[int, ...]:
        """Tickets of the orders that are not yet executed."""
        return tuple(self._orders)
