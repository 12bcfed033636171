"""The learner of the model: a real `TicketCoordinator`, what a checkpoint holds of it, and what was accepted and used.

Rule: a coordinator is taken apart into plain tuples and put together again without loss, except for figures that only a
person reads and for times that are past. Clocks are kept relative to now. Every rule of safety is checked after every event.
"""

from __future__ import annotations

from typing import Self, TypeVar

from learner.members.lane_placement import LanePlacement
from learner.members.membership import Membership, Outgoing
from learner.rollouts.lanes import AcceptedRollout, LaneQueue, Ticket, TicketedLane
from learner.rollouts.ledger import Ledger
from learner.rollouts.ticket_coordinator import CollectingMember, TicketCoordinator
from protocol.messages import ToLearner, WorkerExit
from tests.model.conversation import Content
from tests.model.message_content import (
    hello,
    incarnation,
    peer_of,
    rollout_content,
    rollout_of,
    session,
    ticket,
    weights,
    worker_of,
)
from tests.model.names import Kind, Name, name
from tests.model.settings import TIMEOUT_S, Settings
from tests.support.fake_ends import BUFFERS, PARAMETERS

SAVED: dict[type, set[str]] = {
    TicketCoordinator: {"ledger", "version", "membership", "lanes", "tickets", "ready", "_held_back", "_placement", "_queue"}
    | {"_oldest_ready", "_weights"},
    Membership: {"members", "_next_session", "_joins", "_none_silent_before_s", "_of_process", "_refused"},
    CollectingMember: {"peer", "hello", "session", "join_number", "heard_s", "lanes", "tickets", "replies", "acknowledged"}
    | {"sending", "sending_since", "strikes", "takeovers"},
    TicketedLane: {"number", "incarnation", "owner", "moving", "progress", "started", "outstanding", "next_sequence"}
    | {"out_of_order"},
    Ticket: {"number", "lane", "incarnation", "version", "peer"},
    LanePlacement: {"_lanes", "_unplaced", "_settled", "_waiting_for"},
    LaneQueue: {"_lanes", "_heap"},
}
"""What of each object is saved."""
NOT_SAVED: dict[type, set[str]] = {
    TicketCoordinator: {
        "run",
        "rollouts_per_update",
        "max_lag",
        "max_env_copies",
        "worker_timeout_s",
        "evaluation",
        "_absent",
    }
    | {"_first_version", "_used_before"},  # no run of the model changes its lanes, so counting from 0 gives the same
    Membership: {"events", "draining", "progress", "_run", "_member_class", "_on_removed", "_is_spare"}
    | {"_removed_for_silence", "_stages_of_left"},
    CollectingMember: {
        "joined_s",
        "state",
        "heartbeat",
        "stages_before",
        "steps_per_s",
        "measured",
        "activity",
        "activity_s",
    }
    | {"in_env_code_s", "stepped"},
    TicketedLane: {"newest_used"},  # it marks rollouts as fresh for the algorithm; no message depends on it
    Ticket: set(),
    LanePlacement: {"_tie_break"},
    LaneQueue: set(),
}
"""What is not: constants, figures for people, and parts that no event of the model uses."""


class Learner:
    """One state of the learner, which an event changes."""

    def __init__(self, settings: Settings, coordinator: TicketCoordinator) -> None:
        self.settings, self.coordinator = settings, coordinator
        self.updating = False
        """whether rollouts were taken, and the weights made of them are not published"""
        self.checkpoints: list[Content] = []
        """of each version so far: ticket to issue next, tickets used, incarnations, newest incarnations accepted"""
        self.used: set[int] = set()
        """tickets whose rollouts were used"""
        self.accepted: list[tuple[int, int | None, set[int]]] = [(-1, None, set())] * settings.lanes
        """of each lane: newest incarnation of which a rollout was accepted, the session that collected it, the sequence
        numbers; the session is None if it exists no more
        """

    # ---------------------------------------------------------------- events

    def receive(self, worker: int, message: ToLearner, now: float) -> list[Outgoing]:
        waiting = len(self.coordinator.ready)
        out = self.coordinator.receive(peer_of(worker), message, now)
        for arrived in self.coordinator.ready[waiting:]:
            assert arrived.rollout is message, "a rollout that did not arrive was accepted"
            self._accept(arrived)
        rejected = self.coordinator.ledger.transitions_invalid
        assert rejected == 0, "a rollout of a worker that does all right was rejected"
        return out + self._learn()

    def publish(self) -> list[Outgoing]:
        self.updating = False
        coordinator = self.coordinator
        out = self._publish(coordinator.version + 1)
        return [*out, *self._checkpoint(), *self._learn()]

    def pass_time(self, now: float) -> list[Outgoing]:
        return self.coordinator.remove_silent(now) + self._learn()

    def revoke(self, worker: int) -> list[Outgoing]:
        return self.coordinator.revoke(peer_of(worker), "its key was revoked") + self._learn()

    def process_ended(self, worker: int, nonce: int) -> list[Outgoing]:
        return self.coordinator.process_ended(WorkerExit(f"w{worker}", nonce, "killed", True)) + self._learn()

    def restarted(self, version: int) -> tuple[Self, list[Outgoing]]:
        """A new learner, from the checkpoint of this version."""
        issued, used, incarnations, accepted = self.checkpoints[version]
        settings = self.settings
        coordinator = TicketCoordinator(
            settings.run,
            rollouts_per_update=settings.rollouts_per_update,
            max_lag=settings.max_lag,
            worker_timeout_s=TIMEOUT_S,
            first_session=self.coordinator.membership._next_session,
            ledger=Ledger(issued=issued.value, used=used, lost=issued.value - used),
            incarnations=[number.value for number in incarnations],
        )
        learner = type(self)(settings, coordinator)
        learner.checkpoints = self.checkpoints[:version]
        learner.used = {number for number in self.used if number < issued.value}
        learner.accepted = [(-1 if number is None else number.value, None, set()) for number in accepted]
        out = learner._publish(version)
        return learner, out + learner._checkpoint()

    def is_member(self, worker: int) -> bool:
        return peer_of(worker) in self.coordinator.members

    # ---------------------------------------------------------------- inside

    def _publish(self, version: int) -> list[Outgoing]:
        return self.coordinator.publish(version, PARAMETERS, BUFFERS)

    def _checkpoint(self) -> list[Outgoing]:
        coordinator = self.coordinator
        incarnations = tuple(incarnation(lane, number) for lane, number in enumerate(coordinator.incarnations()))
        accepted = tuple(_accepted(lane, number) for lane, (number, _, _) in enumerate(self.accepted))
        self.checkpoints.append((ticket(coordinator.ledger.issued), coordinator.ledger.used, incarnations, accepted))
        return []

    def _accept(self, arrived: AcceptedRollout) -> None:
        rollout = arrived.rollout
        number, collected_in, sequences = self.accepted[rollout.lane]
        assert arrived.incarnation >= number, "a lane went back to an earlier incarnation"
        if arrived.incarnation > number:
            sequences = set()
        else:
            assert collected_in == rollout.session, "two sessions collected the same incarnation of a lane"
        assert rollout.sequence not in sequences, "a rollout was accepted twice"
        self.accepted[rollout.lane] = arrived.incarnation, rollout.session, sequences | {rollout.sequence}

    def _learn(self) -> list[Outgoing]:
        """Take the rollouts of an update, if there are enough."""
        if self.updating:
            return []
        coordinator, ledger = self.coordinator, self.coordinator.ledger
        before = ledger.transitions_used
        taken = coordinator.take()
        out = coordinator.deal()
        if taken is None:
            return out
        assert len(taken) == self.settings.rollouts_per_update, "an update has another number of rollouts"
        assert ledger.transitions_used - before == len(taken), "an update counted another number of transitions"
        for rollout in (arrived.rollout for arrived in taken):
            assert rollout.ticket not in self.used, "a ticket was used twice"
            self.used.add(rollout.ticket)
            lag = coordinator.version - rollout.version
            assert 0 <= lag <= self.settings.max_lag, f"a rollout of lag {lag} was used"
        if self.settings.max_lag == 0 and self.settings.per_update is None:
            lanes = sorted(arrived.rollout.lane for arrived in taken)
            assert lanes == list(range(self.settings.lanes)), "a synchronous update has not one rollout of each lane"
        self.updating = True
        return out

    def check(self) -> None:
        """The rules that hold in every state."""
        coordinator, ledger = self.coordinator, self.coordinator.ledger
        in_flight = len(coordinator.tickets) + len(coordinator.ready)
        assert ledger.outstanding == in_flight, "the ledger does not balance"
        waiting_steps = sum(arrived.rollout.env_steps for arrived in coordinator.ready)
        assert ledger.transitions_waiting == waiting_steps, "transitions do not balance"
        versions = coordinator.version - coordinator._first_version + 1 + coordinator.max_lag
        bound = coordinator.rollouts_per_update * versions
        used = ledger.used - coordinator._used_before
        assert coordinator._weights is None or used + in_flight <= bound, "more tickets than the bound allows"
        members = coordinator.members
        for lane in coordinator.lanes:
            owners = [member.peer for member in members.values() if lane.number in member.lanes]
            assert owners == ([] if lane.owner is None else [lane.owner]), (
                "a lane has two owners, or its owner does not know"
            )
            mine = {number for number, each in coordinator.tickets.items() if each.lane == lane.number}
            assert mine == lane.outstanding, "a lane does not know its tickets"
            waiting = sum(arrived.rollout.lane == lane.number for arrived in coordinator.ready)
            assert len(mine) + waiting <= lane.progress, "a lane is less advanced than its tickets"
            assert (lane.progress, lane.number) in coordinator._queue._heap, "a lane gets no more tickets"
        for number, each in coordinator.tickets.items():
            assert number in members[each.peer].tickets, "an outstanding ticket is with nobody"
            assert coordinator.lanes[each.lane].owner == each.peer, "a ticket of a lane that its worker does not own"
        assert sum(len(member.tickets) for member in members.values()) == len(coordinator.tickets), (
            "a ticket has two holders"
        )
        processes = {(member.hello.worker, member.hello.process_nonce): member for member in members.values()}
        assert coordinator.membership._of_process == processes, "the processes are not those of the members"


# -------------------------------------------------------------------- to tuples and back


def saved(learner: Learner, now: float) -> Content:
    coordinator = learner.coordinator
    coordinator.membership.events.clear()
    learner.check()
    lanes, membership = coordinator.lanes, coordinator.membership
    tickets = sorted(coordinator.tickets.values(), key=lambda each: each.number)
    waiting_for = coordinator._placement._waiting_for
    return (
        ticket(coordinator.ledger.issued),
        coordinator.ledger.used,
        coordinator.version,
        coordinator._held_back,
        tuple(_lane(lane) for lane in lanes),
        tuple(
            (ticket(t.number), t.lane, incarnation(t.lane, t.incarnation), t.version, _worker(worker_of(t.peer)))
            for t in tickets
        ),
        tuple((rollout_content(r.rollout), incarnation(r.rollout.lane, r.incarnation)) for r in coordinator.ready),
        tuple(
            _member(member, now) for member in sorted(coordinator.members.values(), key=lambda member: member.join_number)
        ),
        tuple(sorted(coordinator._placement._unplaced)),
        coordinator._placement._settled,
        None if waiting_for is None else (session(waiting_for.session), tuple(sorted(waiting_for.lanes))),
        coordinator._oldest_ready,
        None if coordinator._weights is None else coordinator._weights.version,
        session(membership._next_session),
        max(0.0, membership._none_silent_before_s - now),
        tuple(sorted(name(Kind.NONCE, nonce, worker_of(peer)) for peer, (nonce, _) in membership._refused.items())),
        learner.updating,
        tuple(learner.checkpoints),
        tuple(name(Kind.OLD_TICKET, number) for number in sorted(learner.used)),
        tuple(
            (
                _accepted(lane, number),
                () if collected_in is None else (name(Kind.OLD_SESSION, collected_in),),
                tuple(sorted(sequences)),
            )
            for lane, (number, collected_in, sequences) in enumerate(learner.accepted)
        ),
    )


def _accepted(lane: int, number: int) -> Name | None:
    return None if number < 0 else incarnation(lane, number)


def _worker(number: int) -> Name:
    return name(Kind.WORKER, number)


def _lane(lane: TicketedLane) -> Content:
    owner = None if lane.owner is None else _worker(worker_of(lane.owner))
    number = incarnation(lane.number, lane.incarnation)
    arrived = tuple(sorted(lane.out_of_order))
    return number, owner, lane.moving, lane.progress, lane.started, lane.next_sequence, arrived


def _member(member: CollectingMember, now: float) -> Content:
    worker = worker_of(member.peer)

    def replies(count: int) -> Name:
        return name(Kind.REPLIES, count, member.session)

    return (
        _worker(worker),
        name(Kind.NONCE, member.hello.process_nonce, worker),
        name(Kind.ATTEMPT, member.hello.attempt, worker),
        session(member.session),
        max(member.heard_s - now, -TIMEOUT_S - 1.0),
        tuple(sorted(member.lanes)),
        tuple((ticket(number), replies(sent_at)) for number, sent_at in member.tickets.items()),
        replies(member.replies),
        member.acknowledged,
        None if member.sending is None else (member.sending, replies(member.sending_since)),
        member.strikes,
        member.takeovers,
    )


def without_checkpoints(content: Content) -> Content:
    return (*content[:17], (), *content[18:])


def loaded(content: Content, settings: Settings) -> Learner:
    """A learner at the time 0 with this content."""
    issued, used, version, held_back, lanes, tickets, ready, members, *rest = content
    unplaced, settled, waiting_for, oldest_ready, weights_version, next_session, none_silent, refused, *mine = rest
    coordinator = TicketCoordinator(
        settings.run,
        rollouts_per_update=settings.rollouts_per_update,
        max_lag=settings.max_lag,
        worker_timeout_s=TIMEOUT_S,
        first_session=next_session.value,
        ledger=Ledger(issued=issued.value, used=used, lost=issued.value - used - len(tickets) - len(ready)),
        version=version,
    )
    coordinator.ledger.transitions_received = len(ready)
    coordinator._held_back, coordinator._oldest_ready = held_back, oldest_ready
    coordinator._weights = None if weights_version is None else weights(weights_version)
    coordinator.ready = [AcceptedRollout(rollout_of(fields), number.value) for fields, number in ready]
    for lane, (number, owner, moving, progress, started, following, arrived) in zip(coordinator.lanes, lanes, strict=True):
        lane.incarnation, lane.owner = number.value, None if owner is None else peer_of(owner.value)
        lane.moving, lane.progress, lane.started = moving, progress, started
        lane.next_sequence, lane.out_of_order = following, set(arrived)
    coordinator._queue = LaneQueue(coordinator.lanes)
    for number, of_lane, inc, under, worker in tickets:
        coordinator.tickets[number.value] = Ticket(number.value, of_lane, inc.value, under, peer_of(worker.value))
        coordinator.lanes[of_lane].outstanding.add(number.value)
    _load_members(coordinator.membership, members)
    coordinator.membership._none_silent_before_s = none_silent
    coordinator.membership._refused = {peer_of(nonce.scope): (nonce.value, "refused") for nonce in refused}
    placement = coordinator._placement
    placement._unplaced, placement._settled = set(unplaced), settled
    if waiting_for is not None:
        placement._waiting_for = _waiting_for(coordinator, *waiting_for)
    learner = Learner(settings, coordinator)
    learner.updating, learner.checkpoints = mine[0], list(mine[1])
    learner.used = {number.value for number in mine[2]}
    learner.accepted = [
        (-1 if number is None else number.value, collected_in[0].value if collected_in else None, set(sequences))
        for number, collected_in, sequences in mine[3]
    ]
    return learner


def _load_members(membership: Membership[CollectingMember], members: Content) -> None:
    for join_number, fields in enumerate(members):
        worker, nonce, attempt, number, heard, lanes, tickets, replies, acknowledged, sending, strikes, takeovers = fields
        said = hello(worker.value, nonce.value, attempt.value)
        member = CollectingMember(peer_of(worker.value), said, number.value, join_number, heard)
        member.lanes = set(lanes)
        member.tickets = {each.value: sent_at.value for each, sent_at in tickets}
        member.replies, member.acknowledged, member.strikes = replies.value, acknowledged, strikes
        member.takeovers = takeovers
        if sending is not None:
            member.sending, member.sending_since = sending[0], sending[1].value
        membership.members[member.peer] = member
        membership._of_process[said.worker, said.process_nonce] = member
    membership._joins = len(members)


def _waiting_for(coordinator: TicketCoordinator, number: Name, lanes: Content) -> CollectingMember:
    for member in coordinator.members.values():
        if member.session == number.value:
            return member
    gone = CollectingMember(b"gone", hello(0, 0, 1), number.value, 0, 0.0)  # it left, and placement still refers to it
    gone.lanes = set(lanes)
    return gone


L = TypeVar("L", bound=Learner)


def first_learner(settings: Settings, kind: type[L]) -> tuple[L, list[Outgoing]]:
    """A learner of this kind that starts a run."""
    before = kind(
        settings,
        TicketCoordinator(
            settings.run,
            rollouts_per_update=settings.rollouts_per_update,
            max_lag=settings.max_lag,
            worker_timeout_s=TIMEOUT_S,
            first_session=0,
        ),
    )
    none = tuple(incarnation(lane, 0) for lane in range(settings.lanes))
    before.checkpoints = [(ticket(0), 0, none, (None,) * settings.lanes)]
    return before.restarted(0)
