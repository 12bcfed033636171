"""The learner's half of a vector environment's conversation with its workers. Pure: messages and `now` in, messages out.

Rule: an order goes to one lane, and a lane has one order at a time; lanes do not wait for each other. Either the order is
answered, or its lane is lost with its worker. A lost lane starts again on new env copies, in its next incarnation. A lane
leaves its worker only if the worker is lost, because elsewhere it would have new env copies, without the random states and
attributes of the old ones. If a Heartbeat shows that an order was lost on the way, the order is sent again. Steps through
shared memory don't count as orders here. If the infos of such a step are too long for the shared memory, they arrive as a
message.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from millrace.learner.members.coordinator import Coordinator
from millrace.learner.members.lane_placement import LanePlacement, PlacedLane, is_spare
from millrace.learner.members.member import Member
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


@dataclass
class OrderedLane(PlacedLane):
    """A lane whose env copies are stepped by orders."""

    started: bool = False
    """Whether an order was sent to this incarnation. If so, its env copies exist and can be lost."""

    def restart(self) -> None:
        """Record that the lane left its worker. Its next incarnation has new env copies."""
        super().restart()
        self.started = False
        self.incarnation += 1


class OrderCoordinator(Coordinator[Member]):
    """Members, lanes, orders and their answers."""

    def __init__(self, spec: StepSpec, first_session: int, worker_timeout_s: float = math.inf) -> None:
        membership = Membership(spec, Member, self._removed, first_session, lambda member: is_spare(member, self.lanes))
        super().__init__(membership, worker_timeout_s)
        self.spec = spec
        self.lanes = [OrderedLane(lane) for lane in range(len(spec.lanes))]
        self.orders: dict[int, Order] = {}
        """The orders that were sent and have not been answered, by ticket."""
        self.answers: dict[int, Answer] = {}
        """The newest answer of each lane, by lane, until `forget` removes it."""
        self.shared_orders: dict[int, int] = {}
        """By lane, the number of the step through shared memory that is under way."""
        self.infos: dict[int, bytes] = {}
        """By lane, the packed infos of the step through shared memory, if they arrived as a message."""
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

    def forget(self, lane: int) -> None:
        """Forget the answer to a lane's last order, because the caller has taken it."""
        self.answers.pop(lane, None)
        self.shared_orders.pop(lane, None)
        self.infos.pop(lane, None)

    def place(self, lane: int, patient: bool) -> bool:
        """Assign the lane to a worker; if `patient`, only to one without a lane. Returns False if there is none."""
        if self.lanes[lane].owner is not None:
            return True
        candidates = [member for member in self.membership.active() if not (patient and member.lanes)]
        if candidates:
            self._placement.assign([self.lanes[lane]], candidates)
        return bool(candidates)

    def owner(self, lane: int) -> Member | None:
        """The worker to which the lane is assigned, or None."""
        peer = self.lanes[lane].owner
        return None if peer is None else self.members[peer]

    def order(self, lane: int, make_order: MakeOrder) -> list[Outgoing]:
        """Make an order for a lane, which must have a worker, and return the message to send."""
        member = self.owner(lane)
        record = self.lanes[lane]
        assert member is not None
        self._tickets += 1
        order = make_order(member.session, self._tickets, LaneIncarnation(lane, record.incarnation))
        record.started = True
        self.orders[order.ticket] = order
        member.tickets[order.ticket] = member.replies
        return [(member.peer, order)]

    # ---------------------------------------------------------------- inside

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
        order = self.orders.get(message.ticket)
        if order is None or message.ticket not in member.tickets:
            return []  # this answer has arrived before
        try:
            check(message, order, self.spec)
        except BadMessage as error:
            return self._unusable(member, str(error))
        del self.orders[message.ticket], member.tickets[message.ticket]
        self.answers[message.lane] = message
        return []

    def _long_infos(self, member: Member, answer: Answer) -> list[Outgoing]:
        """Store the infos of a step through shared memory, if they belong to the lane's newest step."""
        if not isinstance(answer, Stepped):
            return self._unusable(member, "answer to an order through shared memory: expected Stepped, got Returned")
        mine = answer.lane in member.lanes and self.lanes[answer.lane].incarnation == answer.incarnation
        if mine and self.shared_orders.get(answer.lane) == -answer.ticket:
            self.infos[answer.lane] = bytes(answer.infos.data)
        return []

    def _again(self, member: Member, heartbeat: Heartbeat, lost: Sequence[int]) -> list[Outgoing]:
        member.tickets |= dict.fromkeys(lost, member.replies)
        return [(member.peer, self.orders[ticket]) for ticket in lost]

    def _received(self, member: Member) -> tuple[Received, ...]:
        return tuple(Received(lane, self.lanes[lane].incarnation, 0) for lane in sorted(member.lanes))

    def _removed(self, member: Member, gone: Gone) -> None:
        for ticket in member.tickets:
            del self.orders[ticket]
        for lane in member.lanes:
            if self.lanes[lane].started:
                self.lost[lane] = f"worker {member.hello.worker} ({member.hello.host}) {gone.why}"
        self._placement.removed(member)


def _by_name(member: Member) -> tuple[int, str]:
    """Sort key for workers with equally few lanes: the one whose name comes first gets the next lane."""
    return len(member.hello.worker), member.hello.worker


def check(answer: Answer, order: Order, spec: StepSpec) -> None:
    """Raise `BadMessage`, with a one-line message, if the answer does not belong to this order."""
    if (answer.lane, answer.incarnation) != (order.lane, order.incarnation):
        raise BadMessage(f"answer: expected one from lane {order.lane}, got one from lane {answer.lane}")
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
