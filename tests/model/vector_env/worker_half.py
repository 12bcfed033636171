"""A worker of a vector environment: a real `Session`, its copies, and the order that it executes.

Rules: an order is executed once in a session, on copies of its incarnation; a Step comes after a Reset. An order is executed
when its work begins, and answered when the work is finished, unless its session has ended in between.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from protocol.messages import Answer, Call, Reset, Step, ToLearner
from tests.model.conversation import Content, Event
from tests.model.message_content import incarnation, session, ticket
from tests.model.names import ATTEMPTS, MASK, Kind, name
from tests.model.settings import FOR_EVER_S, TIMEOUT_S
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
from tests.model.worker_part import PAUSE_S
from workers.conversation.held import OrderLane
from workers.conversation.session import (
    CloseLanes,
    Leave,
    SendMessage,
    Session,
    SharedOrders,
    StartSession,
    WorkerEffect,
    WorkerIdentity,
)
from workers.conversation.worker_states import WorkerState

if TYPE_CHECKING:
    from tests.model.vector_env.stepping import Stepping

SAVED = {"_lanes"}
"""What of `HeldOrders` is saved: all."""


@dataclass
class Worker:
    """One state of a worker, which an event changes."""

    number: int
    nonce: int
    """of its process; a later process has a larger one"""
    session: Session | None = None
    """None: its process has ended"""
    work: Answer | None = None
    """the answer to the order that is executed"""
    copies: dict[int, tuple[int, Copy]] = field(default_factory=dict)
    """by lane: incarnation and state"""
    newest: tuple[int, int] = (-1, -1)
    """session and ticket of the order that was executed last"""
    frozen: bool = False
    shut_out: bool = False

    def event(self, event: Event, message: Content | None, run: Stepping, now: float) -> list[ToLearner]:
        """What the worker says after this event."""
        current = self.session
        match event:
            case "handle", _:
                assert message is not None
                assert current is not None
                return self._turn(current.handle(message_of(message, self.number, run.run), now), now)
            case ("start",):
                self.nonce += ATTEMPTS
                self.shut_out = False
                who = WorkerIdentity(f"w{self.number}", "host", 1, self.nonce, "model")
                self.session = Session(who, now, join_timeout_s=FOR_EVER_S, rejoin_timeout_s=FOR_EVER_S)
                return self._turn([], now)
            case ("finish",):
                assert current is not None
                assert self.work is not None
                done, self.work = self.work, None
                return self._turn(current.work_ended([done]), now)
            case ("time",):
                return [] if current is None or self.frozen else self._turn([], now)
            case ("told",):
                assert current is not None
                return self._turn(current.refused("its key was revoked"), now)
            case ("end",):
                self._end()
            case ("shut out",):
                self.shut_out = True
            case ("freeze",) | ("thaw",):
                self.frozen = event == ("freeze",)
        return []

    def _end(self) -> None:
        self.session = self.work = None
        self.copies, self.newest, self.frozen = {}, (-1, -1), False

    def _turn(self, effects: list[WorkerEffect], now: float) -> list[ToLearner]:
        """Do what the program does after each event."""
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
            assert (order.session, order.ticket) != self.newest, "an order was executed twice"
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
                    self._end()
        return sent


# -------------------------------------------------------------------- to tuples and back


def saved(worker: Worker, now: float) -> Content:
    """The process, its session, the orders that it holds, its copies, and what it executes."""
    nonce = name(Kind.NONCE, worker.nonce, worker.number)
    flags = worker.frozen, worker.shut_out
    current = worker.session
    if current is None:
        return nonce, flags, None, None
    held = current._current
    fields = (
        current.state,
        None if current.run is None else session(current.session),
        name(Kind.ATTEMPT, current._attempt, worker.number),
        max(current._unanswered_s - now, -TIMEOUT_S - 1.0),
        max(current.due_s - now, 0.0),
        tuple(_lane(number, lane) for number, lane in sorted(held.orders._lanes.items())),
        held.in_progress,
        None if current.run is None else name(Kind.REPLIES, held.replies, current.session),
        tuple((lane, incarnation(lane, life), state) for lane, (life, state) in sorted(worker.copies.items())),
        None if worker.newest[0] != current.session else ticket(worker.newest[1]),
    )
    return nonce, flags, fields, None if worker.work is None else content_of(worker.work, worker.number)


def _lane(number: int, lane: OrderLane) -> Content:
    order = next(map(order_content, lane.asked.values()), None)
    kept = next((content_of(each, 0) for each in lane.answered.values()), None)
    assert {*lane.asked, *lane.answered} == {lane.newest}, "a worker holds another order than the newest"
    return number, incarnation(number, lane.incarnation), ticket(lane.newest), order, kept


def loaded(content: Content, number: int, run: Stepping) -> Worker:
    """A worker at the time 0 with this content."""
    nonce, (frozen, shut_out), fields, work = content
    worker = Worker(number, nonce.value, frozen=frozen, shut_out=shut_out)
    if fields is None:
        return worker
    state, of_session, attempt, heard, due, lanes, in_progress, replies, copies, newest = fields
    who = WorkerIdentity(f"w{number}", "host", 1, nonce.value, "model")
    current = worker.session = Session(who, 0.0, join_timeout_s=FOR_EVER_S, rejoin_timeout_s=FOR_EVER_S)
    current.session = MASK  # before its first session: not that of any message
    current.state, current._attempt = WorkerState(state), attempt.value
    current._unanswered_s, current.due_s, current._backoff_s = heard, due, PAUSE_S
    held = current._current
    held.in_progress = in_progress
    if of_session is not None:
        current.run, current.session, held.replies = run.run, of_session.value, replies.value
    for lane, life, newest_of_lane, order, kept in lanes:
        here = held.orders._lanes[lane] = OrderLane(life.value, newest_of_lane.value)
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
