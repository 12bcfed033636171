"""A worker of a vector environment: a real `Session`, its copies, and the order that it executes.

Rules: an order is executed once in a session, on copies of its incarnation; a Step comes after a Reset. An order is executed
when its work begins, and answered when the work is finished, unless its session has ended in between.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from millrace.protocol.messages import Answer, Call, Reset, Step, ToLearner
from millrace.protocol.rules import Rule
from millrace.workers.conversation.held import OrderLane
from millrace.workers.conversation.session import CloseLanes, Leave, SendMessage, SharedOrders, StartSession, WorkerEffect
from tests.model import process_part
from tests.model.conversation import Content
from tests.model.message_content import incarnation, ticket
from tests.model.process_part import Process
from tests.model.vector_env.order_content import (
    NEW,
    Copy,
    answer,
    content_of,
    executed,
    message_of,
    order_content,
    order_of,
)

if TYPE_CHECKING:
    from tests.model.vector_env.stepping import Stepping

SAVED = {"_lanes"}
"""What of `HeldOrders` is saved: all."""


@dataclass
class Worker(Process):
    """One state of a worker, which an event changes."""

    settings: Stepping
    work: Answer | None = None
    """the answer to the order that is executed"""
    copies: dict[int, tuple[int, Copy]] = field(default_factory=dict)
    """by lane: incarnation and state"""
    newest: tuple[int, int] = (-1, -1)
    """session and ticket of the order that was executed last"""

    def finish(self, now: float) -> list[ToLearner]:
        assert self.session is not None
        assert self.work is not None
        done, self.work = self.work, None
        return self.turn(self.session.work_ended([done]), now)

    def end(self) -> None:
        super().end()
        self.work, self.copies, self.newest = None, {}, (-1, -1)

    def turn(self, effects: list[WorkerEffect], now: float) -> list[ToLearner]:
        current = self.session
        assert current is not None
        sent = self._do(effects)
        if self.work is not None and current.is_unwanted(SharedOrders(self.work.session)):
            self.copies.pop(self.work.lane, None)
            self.work = None
            sent += self._do(current.work_ended([]))
        if self.session is not None and (order := current.next_work()) is not None:
            assert self.work is None, "a worker executes two orders at the same time"
            assert isinstance(order, Reset | Step | Call)
            life, state = self.copies.get(order.lane, (order.incarnation, NEW))
            assert (order.session, order.ticket) != self.newest, f"{Rule.ORDER_ONCE}: an order was executed twice"
            state = executed(order, state if life == order.incarnation else NEW)
            self.newest = order.session, order.ticket
            self.copies[order.lane] = order.incarnation, state
            self.work = answer(order, state)
        return sent + self._do(current.tick(now))

    def _do(self, effects: list[WorkerEffect]) -> list[ToLearner]:
        sent: list[ToLearner] = []
        for effect in effects:
            match effect:
                case SendMessage(message):
                    sent.append(message)
                case StartSession():
                    self.copies.clear()
                case CloseLanes(lanes):
                    for lane in lanes:
                        self.copies.pop(lane.lane, None)
                case Leave():
                    self.end()
        return sent


# -------------------------------------------------------------------- to tuples and back


def saved(worker: Worker, now: float) -> Content:
    """The process, its session, the orders that it holds, its copies, and what it executes."""
    current = worker.session
    more: Content = ()
    if current is not None:
        more = (
            tuple(_lane(number, lane) for number, lane in sorted(current._current.orders._lanes.items())),
            tuple((lane, incarnation(lane, life), state) for lane, (life, state) in sorted(worker.copies.items())),
            None if worker.newest[0] != current.session else ticket(worker.newest[1]),
        )
    return process_part.saved(worker, now, more, None if worker.work is None else content_of(worker.work, worker.number))


def _lane(number: int, lane: OrderLane) -> Content:
    order = next(map(order_content, lane.asked.values()), None)
    kept = next((content_of(each, 0) for each in lane.answered.values()), None)
    assert {*lane.asked, *lane.answered} == {lane.newest}, f"{Rule.ORDER_OLD}: a worker holds another order than the newest"
    return number, incarnation(number, lane.incarnation), ticket(lane.newest), order, kept


def loaded(content: Content, number: int, run: Stepping) -> Worker:
    """A worker at the time 0 with this content."""
    worker, more = process_part.loaded(Worker, content, number, run)
    current = worker.session
    if current is None:
        return worker
    (lanes, copies, newest), work = more, content[3]
    for lane, life, newest_of_lane, order, kept in lanes:
        here = current._current.orders._lanes[lane] = OrderLane(life.value, newest_of_lane.value)
        if order is not None:
            here.asked[here.newest] = order_of(current.session, order)
        if kept is not None:
            here.answered[here.newest] = message_of(kept, number, run.run)
    worker.copies = {lane: (life.value, state) for lane, life, state in copies}
    if newest is not None:
        worker.newest = current.session, newest.value
    if work is not None:
        worker.work = message_of(work, number, run.run)
    return worker
