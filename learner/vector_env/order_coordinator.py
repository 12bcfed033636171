"""The learner's half of a vector environment's conversation with its workers. Pure: messages and `now` in, messages out.

Rule: an order goes to one lane, and a lane has one order at a time; lanes do not wait for each other. Either the order is
answered, or its lane is lost with its worker, or the caller no longer wants the answer, and the lane's next order replaces
it, as it does at the worker. A lost lane starts again on new env copies, in its next incarnation. A lane leaves its worker
only if the worker is lost, because elsewhere it would have new env copies, without the random states and attributes of the
old ones. If a Heartbeat shows that an order was lost on the way, the order is sent again. Steps through shared memory don't
count as orders here. If the infos of such a step are too long for the shared memory, they arrive as a message.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from millrace.learner.members.coordinator import Coordinator
from millrace.learner.members.lane_placement import LanePlacement, PlacedLane, is_spare
from millrace.learner.members.member import Member, SentTicket
from millrace.learner.members.membership import Gone, Membership, Outgoing
from millrace.protocol.errors import BadMessage
from millrace.protocol.messages import (
    Answer,
    Call,
    Described,
    Goodbye,
    Heartbeat,
    LaneIncarnation,
    Order,
    Received,
    Returned,
    Stepped,
    ToLearner,
)
from millrace.protocol.rows.stepped import wrong_rows
from millrace.protocol.specs import StepSpec
from millrace.protocol.wire.plain_values import unpack

MakeOrder = Callable[[int, int, LaneIncarnation], Order]
"""Makes an order for a lane from the session, the ticket, and the lane's number and incarnation."""


@dataclass(frozen=True)
class WaitingOrder:
    """An order of a lane that has no worker yet."""

    make_order: MakeOrder
    since_s: float
    """when it began to wait"""


@dataclass(frozen=True)
class SentOrder:
    """An order that the lane's worker has not answered."""

    order: Order
    wanted: bool = True
    """Whether the caller wants the answer. Even if not, the worker may execute the order until it gets the next one."""


@dataclass(frozen=True)
class AnsweredOrder:
    """The answer to an order, until the caller takes it."""

    answer: Answer


@dataclass
class OrderedLane(PlacedLane):
    """A lane whose env copies are stepped by orders."""

    started: bool = False
    """Whether an order was sent to this incarnation. If so, its env copies exist and can be lost."""
    order: WaitingOrder | SentOrder | AnsweredOrder | None = None
    """The lane's newest order, or None if there is nothing to send, to wait for or to take."""
    long_infos: Stepped | None = None
    """The newest infos of a step through shared memory that arrived as a message, because they were too long."""

    @property
    def is_awaited(self) -> bool:
        """Whether the caller wants the answer to an order that waits for a worker, or that the worker has not answered."""
        match self.order:
            case SentOrder(wanted=wanted):
                return wanted
            case WaitingOrder():
                return True
        return False

    def restart(self) -> None:
        """Record that the lane left its worker. Its next incarnation has new env copies."""
        self.started = False
        self.incarnation += 1
        if isinstance(self.order, SentOrder):
            self.order = None
        super().restart()  # last, because `begin_anew` repeats a restart that was interrupted before this line


class OrderCoordinator(Coordinator):
    """Members, lanes, orders and their answers."""

    def __init__(self, spec: StepSpec, first_session: int, worker_timeout_s: float = math.inf) -> None:
        membership = Membership(spec, self._removed, first_session, lambda member: is_spare(member, self.lanes))
        super().__init__(membership, worker_timeout_s)
        self.spec = spec
        self.lanes = [OrderedLane(lane) for lane in range(len(spec.lanes))]
        self.lost: dict[int, str] = {}
        """Lanes whose env copies are gone, with the reason, until the vector environment has handled them."""
        self._placement = LanePlacement(self.lanes, _by_name)
        self._tickets = 0

    def give_up(self, member: Member, why: str) -> list[Outgoing]:
        """Remove this worker, because the learner no longer waits for it.

        A worker with the same name but another key stays.
        """
        self.membership.remove(member, Gone(why))
        return []

    # ---------------------------------------------------------------- the vector environment's side

    def take_lost(self) -> dict[int, str]:
        """Lanes whose env copies were lost since the last call, and why."""
        lost = self.lost
        self.lost = {}
        return lost

    @property
    def has_orders(self) -> bool:
        """Whether a lane has an order that waits for a worker or its answer, or an answer that wasn't taken."""
        return any(lane.order is not None for lane in self.lanes)

    @property
    def waiting(self) -> list[int]:
        """The lanes whose order waits for a worker."""
        return [lane.number for lane in self.lanes if isinstance(lane.order, WaitingOrder)]

    def ask(self, lane: int, make_order: MakeOrder, now: float) -> None:
        """Give a lane an order, for `send_waiting` to send. It replaces an order whose answer nobody wants."""
        record = self.lanes[lane]
        if isinstance(record.order, SentOrder) and (member := self.owner(lane)) is not None:
            member.tickets.pop(record.order.order.ticket, None)  # an interrupt may have left an order without its ticket
        record.order = WaitingOrder(make_order, now)

    def send_waiting(self, lanes: Iterable[int], now: float, patience_s: float) -> list[Outgoing]:
        """Send the orders of these lanes, which wait for a worker. Returns the messages.

        A lane that no worker has gets one; if it has waited for less than `patience_s`, only one that has no lane.
        """
        out: list[Outgoing] = []
        for number in lanes:
            lane = self.lanes[number]
            match lane.order:
                case WaitingOrder(make_order, since_s) if self._place(lane, patient=now - since_s < patience_s):
                    out.append(self._send(lane, make_order))
                case _:
                    pass
        return out

    def take(self) -> dict[int, Answer]:
        """Take the answers that have arrived, by lane."""
        answers = dict[int, Answer]()
        for lane in self.lanes:
            if isinstance(lane.order, AnsweredOrder):
                answers[lane.number] = lane.order.answer
                lane.order = None
        return answers

    def forget(self, lane: int) -> None:
        """Forget the lane's order, because the caller no longer wants the answer."""
        record = self.lanes[lane]
        match record.order:
            case SentOrder():
                record.order = replace(record.order, wanted=False)
            case _:
                record.order = None

    def begin_anew(self) -> None:
        """Forget all orders after a call that was cut short.

        The call may have removed a worker without taking its lanes away, or may have assigned only half of a lane.
        """
        for lane in self.lanes:
            self.forget(lane.number)
            if lane.owner is not None:
                member = self.members.get(lane.owner)
                if member is None or lane.number not in member.lanes:
                    lane.restart()

    def owner(self, lane: int) -> Member | None:
        """The worker to which the lane is assigned, or None."""
        peer = self.lanes[lane].owner
        return None if peer is None else self.members[peer]

    # ---------------------------------------------------------------- inside

    def _place(self, lane: OrderedLane, *, patient: bool) -> bool:
        """Assign the lane to a worker; if `patient`, only to one without a lane. Returns False if there is none."""
        if lane.owner is not None:
            return True
        candidates = [member for member in self.membership.active() if not (patient and member.lanes)]
        if candidates:
            self._placement.assign([lane], candidates)
        return bool(candidates)

    def _send(self, lane: OrderedLane, make_order: MakeOrder) -> Outgoing:
        """Make the order of a lane, which has a worker. Returns the message."""
        member = self.owner(lane.number)
        assert member is not None
        self._tickets += 1
        order = make_order(member.session, self._tickets, LaneIncarnation(lane.number, lane.incarnation))
        lane.started = True
        lane.order = SentOrder(order)
        member.tickets[order.ticket] = SentTicket(member.replies)
        return member.peer, order

    def _answer(self, member: Member, message: ToLearner) -> list[Outgoing]:
        match message:
            case Heartbeat():
                return self._heartbeat(member, message)
            case Stepped() | Returned():
                return self._take_answer(member, message)
            case Described():
                return []  # the answer to a request from before the vector environment began
            case Goodbye(_, reason):
                self.membership.leave(member, reason)
                return []
        return self._unusable(member, f"it sent {type(message).__name__}, which a vector environment does not ask for")

    def _take_answer(self, member: Member, message: Answer) -> list[Outgoing]:
        if message.ticket < 0:
            return self._long_infos(member, message)
        if message.ticket not in member.tickets:
            return []  # this answer has arrived before, or the lane has a newer order
        sent = self.lanes[message.lane].order if message.lane in member.lanes else None
        if not isinstance(sent, SentOrder) or sent.order.ticket != message.ticket:
            return self._unusable(member, f"answer: expected one from another lane, got one from lane {message.lane}")
        try:
            check(message, sent.order, self.spec)
        except BadMessage as error:
            return self._unusable(member, str(error))
        del member.tickets[message.ticket]
        self.lanes[message.lane].order = AnsweredOrder(message) if sent.wanted else None
        return []

    def _long_infos(self, member: Member, answer: Answer) -> list[Outgoing]:
        """Keep the infos of a step through shared memory, whose number is the negative ticket."""
        if not isinstance(answer, Stepped):
            return self._unusable(member, "answer to an order through shared memory: expected Stepped, got Returned")
        if answer.lane in member.lanes and self.lanes[answer.lane].incarnation == answer.incarnation:
            self.lanes[answer.lane].long_infos = answer
        return []

    def _again(self, member: Member, heartbeat: Heartbeat, lost: Sequence[int]) -> list[Outgoing]:
        member.tickets |= dict.fromkeys(lost, SentTicket(member.replies))
        unanswered = [each for lane in member.lanes if isinstance(each := self.lanes[lane].order, SentOrder)]
        orders = {sent.order.ticket: sent.order for sent in unanswered}
        return [(member.peer, orders[ticket]) for ticket in lost]

    def _received(self, member: Member) -> tuple[Received, ...]:
        return tuple(Received(lane, self.lanes[lane].incarnation, 0) for lane in sorted(member.lanes))

    def _removed(self, member: Member, gone: Gone) -> None:
        for lane in member.lanes:
            if self.lanes[lane].started:
                self.lost[lane] = f"worker {member.hello.worker} ({member.hello.host}) {gone.why}"
        self._placement.removed(member)


def _by_name(member: Member) -> tuple[int, str]:
    """Sort key for workers with equally few lanes: the one whose name comes first gets the next lane."""
    return len(member.hello.worker), member.hello.worker


def check(answer: Answer, order: Order, spec: StepSpec) -> None:
    """Raise `BadMessage`, with a one-line message, if the answer does not belong to this order."""
    if answer.incarnation != order.incarnation:
        raise BadMessage(f"answer: expected one of incarnation {order.incarnation}, got one of {answer.incarnation}")
    if isinstance(answer, Returned) != isinstance(order, Call):
        kind = "Returned" if isinstance(order, Call) else "Stepped"
        raise BadMessage(f"answer to {type(order).__name__}: expected {kind}, got {type(answer).__name__}")
    if isinstance(answer, Returned):
        if not answer.error and isinstance(order, Call):
            _check_results(answer, order)
        return
    if why := wrong_rows(answer, spec, axes=None):
        raise BadMessage(why)


def _check_results(answer: Returned, order: Call) -> None:
    results = unpack(answer.results.data, len(order.copies))
    expected = 0 if order.assign else len(order.copies)
    if not isinstance(results, list) or len(results) != expected:
        got = f"{len(results)} in a list" if isinstance(results, list) else type(results).__name__
        raise BadMessage(f"results: expected a list of {expected}, got {got}")
