"""The learner of a vector environment: a real `OrderCoordinator` and the program that calls, to tuples and back.

Rule: nothing is lost on the way, except for what only a person reads. After every event, the rules that hold in every state
are checked: a lane has one owner, the order of a lane is with its owner, and a worker has no other orders.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from millrace.learner.members.membership import Outgoing
from millrace.learner.vector_env.order_coordinator import (
    AnsweredOrder,
    OrderCoordinator,
    OrderedLane,
    SentOrder,
    WaitingOrder,
)
from millrace.learner.vector_env.sent_lanes import Asked, AskedReset, Sent
from millrace.protocol.messages import ToLearner, WorkerExit
from tests.model import membership_part
from tests.model.conversation import Content, Event
from tests.model.message_content import incarnation, peer_of, session, ticket, worker_of
from tests.model.names import Kind, name
from tests.model.settings import TIMEOUT_S
from tests.model.vector_env.caller import Caller
from tests.model.vector_env.order_content import NOTHING, content_of, make_order, message_of, order_content, order_of

if TYPE_CHECKING:
    from tests.model.vector_env.stepping import Stepping

SAVED = {"membership", "lanes", "lost", "_tickets"}
"""What of `OrderCoordinator` is saved."""
NOT_SAVED = {"spec", "worker_timeout_s", "_placement"}
"""What is not: constants, and placement, which remembers nothing in the methods that are used."""


class Learner:
    """One state of the learner, which an event changes."""

    def __init__(self, settings: Stepping, first_session: int, now: float) -> None:
        self.settings = settings
        self.coordinator = OrderCoordinator(settings.run, first_session, TIMEOUT_S)
        self.caller = Caller(self.coordinator, settings, now)

    def event(self, event: Event, message: Content | None) -> tuple[Learner, list[Outgoing]]:
        """The learner after this event, and what it sends."""
        coordinator, caller = self.coordinator, self.caller
        sent = caller.server.sent
        match event:
            case "receive", worker, _:
                assert message is not None
                heard: ToLearner = message_of(message, worker, self.settings.run)
                sent += coordinator.receive(peer_of(worker), heard, caller.now)
            case ("publish",):
                caller.go_on()
            case ("time",):
                caller.pass_time()
            case "revoke", worker:
                sent += coordinator.revoke(peer_of(worker), "its key was revoked")
            case "ended", worker, nonce:
                sent += coordinator.process_ended(WorkerExit(f"w{worker}", nonce, "killed", True))
            case "restart", _:
                return Learner(self.settings, coordinator.membership._next_session, caller.now), []
        caller.turn()
        return self, sent

    def check(self) -> None:
        """The rules that hold in every state."""
        coordinator = self.coordinator
        members = coordinator.members
        for lane in coordinator.lanes:
            owners = [member.peer for member in members.values() if lane.number in member.lanes]
            assert owners == ([] if lane.owner is None else [lane.owner]), (
                "a lane has two owners, or its owner does not know"
            )
        sent = [(lane, lane.order.order) for lane in coordinator.lanes if isinstance(lane.order, SentOrder)]
        for lane, order in sent:
            member = coordinator.owner(lane.number)
            assert member is not None, "an order is with nobody"
            assert order.ticket in member.tickets, "an order is not with the owner of its lane"
            assert order.lane == lane.number, "an order of another lane"
            assert order.session == member.session, "an order of an earlier session"
            assert order.incarnation == lane.incarnation, "an order of an earlier incarnation"
        assert sum(len(member.tickets) for member in members.values()) == len(sent), (
            "a worker holds an order that is not its lane's newest"
        )


# -------------------------------------------------------------------- to tuples and back


def saved(learner: Learner) -> Content:
    """The members, the lanes, the orders, and the caller."""
    learner.check()
    coordinator, caller = learner.coordinator, learner.caller
    return (
        membership_part.saved(coordinator.membership, caller.now),
        tuple(
            (
                incarnation(lane.number, lane.incarnation),
                None if lane.owner is None else name(Kind.WORKER, worker_of(lane.owner)),
                lane.started,
                _of_lane(lane, caller),
            )
            for lane in coordinator.lanes
        ),
        tuple(sorted(coordinator.lost)),
        ticket(coordinator._tickets),
        _caller(caller),
    )


def _of_lane(lane: OrderedLane, caller: Caller) -> Content:
    match lane.order:
        case None:
            return ()
        case WaitingOrder():
            return ("waiting",)  # for the order that the caller has sent
        case SentOrder(order, wanted):
            return "sent", session(order.session), order_content(order), caller.ages.get(order.ticket, 0), wanted
        case AnsweredOrder(answer):
            return "answered", content_of(answer, 0)


def _asked(caller: Caller, lane: int, sent: Sent) -> Content:
    return *caller.kind(lane, sent), sent.asked is Asked.STEP, sent.attempts, max(sent.since_s - caller.now, -99.0)


def _caller(caller: Caller) -> Content:
    sent, reset_lanes, lost_lanes = caller.send_recv._sent, caller.send_recv._reset_lanes, caller.send_recv._lost_lanes
    return (
        caller.at,
        None if not caller.waits else 0,
        tuple((lane, *_asked(caller, lane, sent.sent[lane])) for lane in sorted(sent.under_way)),
        tuple(
            (lane, lane in sent._losses, incarnation(lane, reset_lanes[lane]) if lane in reset_lanes else None)
            for lane in sorted(sent._results)
        ),
        tuple(sorted(caller.send_recv._to_raise)),
        tuple((lane, incarnation(lane, life), state) for lane, (life, state) in sorted(caller.copies.items())),
        tuple(sorted(lost_lanes.unreported)),
        tuple(sorted(lost_lanes.awaiting_reset)),
        tuple(sorted(caller.told)),
        tuple(caller.send_recv._ever_reset.tolist()),
    )


def loaded(content: Content, settings: Stepping, now: float) -> Learner:
    """A learner at this time, with the content that it had at the time 0."""
    members, lanes, lost, tickets, of_caller = content
    learner = Learner(settings, members[1].value, now)
    coordinator, caller = learner.coordinator, learner.caller
    membership_part.load(coordinator.membership, members)
    for lane, (life, owner, started, of_lane) in zip(coordinator.lanes, lanes, strict=True):
        lane.incarnation, lane.started = life.value, started
        lane.owner = None if owner is None else peer_of(owner.value)
        match of_lane:
            case "sent", number, of_order, age, wanted:
                order = order_of(number.value, of_order)
                caller.ages[order.ticket] = age
                lane.order = SentOrder(order, wanted)
            case "answered", answer:
                lane.order = AnsweredOrder(message_of(answer, 0, settings.run))
    coordinator.lost = dict.fromkeys(lost, "lost")
    coordinator._tickets = tickets.value
    _load_caller(caller, of_caller, waiting=[n for n, (*_, of_lane) in enumerate(lanes) if of_lane[:1] == ("waiting",)])
    return learner


def _load_caller(caller: Caller, content: Content, waiting: Sequence[int]) -> None:
    at, waits, under_way, ready, to_raise, copies, unreported, awaiting, told, ever_reset = content
    caller.at, caller.waits, caller.told = at, waits is not None, set(told)
    sent, lost_lanes = caller.send_recv._sent, caller.send_recv._lost_lanes
    lost_lanes.add(dict.fromkeys(unreported, "lost"))
    lost_lanes.expect_reset(awaiting)
    for lane, kind, seed, is_step, attempts, since_s in under_way:
        asked = Asked.STEP if is_step else Asked.CALL if kind == "call" else AskedReset((0,), (seed,), NOTHING)
        sent.sent[lane] = Sent(asked, since_s, attempts)
        if lane in waiting:
            caller.coordinator.lanes[lane].order = WaitingOrder(make_order(kind, seed), 0.0)
    for lane, lost, reset in ready:
        sent.sent[lane], sent._results[lane] = Sent(Asked.STEP, 0.0), b""
        sent._losses |= {lane: {}} if lost else {}
        caller.send_recv._reset_lanes |= {lane: reset.value} if reset is not None else {}
    caller.send_recv._to_raise = dict.fromkeys(to_raise, "lost")
    caller.copies = {lane: (life.value, state) for lane, life, state in copies}
    caller.send_recv._ever_reset[:] = ever_reset
