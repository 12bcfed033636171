"""The learner of the model: a real `TicketCoordinator`, what a checkpoint holds of it, and what was accepted and used.

Rule: a coordinator is taken apart into plain tuples and put together again without loss, except for figures that only a
person reads and for times that are past. Clocks are kept relative to now. Every rule of safety is checked after every event.
"""

from __future__ import annotations

from typing import Self, TypeVar

from millrace.learner.members.lane_placement import LanePlacement
from millrace.learner.members.member import Member
from millrace.learner.members.membership import Membership, Outgoing
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.lane_history import LaneHistories
from millrace.learner.rollouts.lanes import TakenRollouts, Ticket, TicketedLane
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout, RolloutDealer
from millrace.learner.rollouts.sent_weights import Confirmed, SentAfter, SentWeights, Standing, WeightsHeld
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.messages import Permit, ToLearner, WorkerExit
from millrace.protocol.rules import Rule
from tests.model import membership_part
from tests.model.conversation import Content
from tests.model.message_content import (
    fields_of,
    hello,
    incarnation,
    peer_of,
    record_of,
    rollout_content,
    rollout_of,
    session,
    ticket,
    weights,
    worker_of,
)
from tests.model.names import Kind, Name, name
from tests.model.settings import TIMEOUT_S, Settings
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, any_rows, fake_past, place_of
from tests.support.conversation.rules import check_tickets, waiting_rollouts

MOST_STEPS = 1_000  # of an episode that is repeated
SAVED: dict[type, set[str]] = {
    TicketCoordinator: {"version", "membership", "rollouts", "weights", "_placement"},
    RolloutDealer: {"lanes", "ledger", "held", "ready", "rounds", "weights", "_to_deal"},
    SentWeights: {"kept", "held"},
    WeightsHeld: {"by_worker"},
    Membership: {"members", "_next_session", "_joins", "_none_silent_before_s", "_of_process", "_refused"},
    Member: {"peer", "hello", "session", "join_number", "heard_s", "lanes", "tickets", "replies"}
    | {"strikes", "takeovers", "welcomed", "describes"},
    TicketedLane: {"number", "incarnation", "owner", "moving", "due", "dealt", "next_sequence", "out_of_order"} | {"taken"},
    TakenRollouts: {"history"},
    Ticket: {"permit", "version", "peer"},
    LanePlacement: {"_lanes", "_unplaced", "_settled", "_waiting_for"},
    Rounds: {"next", "_versions", "_saved"},
}
"""What of each object is saved."""
NOT_SAVED: dict[type, set[str]] = {
    TicketCoordinator: {"run", "worker_timeout_s", "evaluation", "_notes", "_check_rows"},
    RolloutDealer: {"_absent", "_absent_pasts", "opponents", "histories", "_first_round", "_steps_before"},
    SentWeights: set(),
    WeightsHeld: {"by_supervisor"},
    Membership: {"events", "draining", "progress", "_run", "_on_removed", "is_spare", "has_policy_code"}
    | {"_first_session", "_removed_for_silence", "_stages_of_left"},
    Member: {
        "joined_s",
        "draining",
        "heartbeat",
        "stages_before",
        "activity",
        "activity_s",
    }
    | {"in_env_code_s", "speed", "first_step_s", "ended_steps", "supervisor"},
    TicketedLane: {"before", "failures", "losses", "continued_in_vain"},  # no update is undone, no worker lost three times
    TakenRollouts: {"newest"},  # it marks rollouts as fresh
    Ticket: set(),
    LanePlacement: {"_tie_break"},
    Rounds: {"max_lag"},
}
"""What is not: constants, figures for people, what follows from the version, as the opponents do, or from tickets, as the
versions that they name, and parts that no event of the model uses."""


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
        waiting = {arrived.rollout.ticket for arrived in waiting_rollouts(self.coordinator)}
        out = self.coordinator.receive(peer_of(worker), message, now)
        for arrived in waiting_rollouts(self.coordinator):
            if arrived.rollout.ticket not in waiting:
                assert arrived.rollout is message, "a rollout that did not arrive was accepted"
                self._accept(arrived)
        rejected = self.coordinator.rollouts.ledger.transitions_invalid
        assert rejected == 0, f"{Rule.WRONG_ROLLOUT}: a rollout of a worker that does all right was rejected"
        return out + self._learn()

    def publish(self) -> list[Outgoing]:
        self.updating = False
        coordinator = self.coordinator
        out = self._publish(coordinator.version + 1)
        return [*out, *self._checkpoint(), *self._gather()]

    def pass_time(self, now: float) -> list[Outgoing]:
        return self.coordinator.remove_silent(now) + self._learn()

    def revoke(self, worker: int) -> list[Outgoing]:
        return self.coordinator.revoke(peer_of(worker), "its key was revoked") + self._learn()

    def process_ended(self, worker: int, nonce: int) -> list[Outgoing]:
        return self.coordinator.process_ended(WorkerExit(f"w{worker}", nonce, "killed", True)) + self._learn()

    def restarted(self, version: int) -> tuple[Self, list[Outgoing]]:
        """A new learner, from the checkpoint of this version."""
        issued, used, incarnations, accepted, rounds, places = self.checkpoints[version]
        settings = self.settings
        coordinator = TicketCoordinator(
            settings.run,
            RolloutDealer(
                settings.run.lanes,
                Rounds(settings.max_lag, rounds[0], dict(rounds[1])),
                ledger=Ledger(issued=issued.value, used=used, lost=issued.value - used),
                incarnations=[number.value for number in incarnations],
                opponents=settings.pool(version - 1),
                histories=_histories(places),
            ),
            worker_timeout_s=TIMEOUT_S,
            first_session=self.coordinator.membership._next_session,
            check_rows=any_rows,
        )
        acting = coordinator.rollouts.rounds.acting() - {version}
        coordinator.weights.kept = {each: weights(each) for each in (*_snapshots(coordinator), *acting)}
        learner = type(self)(settings, coordinator)
        learner.checkpoints = self.checkpoints[:version]
        learner.used = {number for number in self.used if number < issued.value}
        learner.accepted = [(-1 if number is None else number.value, None, set()) for number in accepted]
        out = learner._resume(version)
        return learner, [*out, *learner._checkpoint(), *learner._gather()]

    def named(self) -> list[tuple[Member, int]]:
        """Which versions the orders of which workers name."""
        members, evaluation = self.coordinator.members.values(), self.coordinator.evaluation.pending
        versions = {number: {each.version, each.permit.opponent} for number, each in self.coordinator.rollouts.held.items()}
        if evaluation is not None:
            versions |= {number: {evaluation.version} for number in evaluation.playing}
        every = ((member, version) for member in members for number in member.tickets for version in versions[number])
        return [(member, version) for member, version in every if version is not None]

    # ---------------------------------------------------------------- inside

    def _resume(self, version: int) -> list[Outgoing]:
        """A learner that has restarted publishes the weights of its checkpoint."""
        return self._publish(version)

    def _publish(self, version: int) -> list[Outgoing]:
        self._set_weights(version)
        return self.coordinator.begin_update()

    def _set_weights(self, version: int) -> None:
        self.coordinator.publish(version, PARAMETERS, BUFFERS, env_steps=version)
        assert self._needed().issuperset(self.coordinator.weights.kept), "the learner keeps weights that nobody needs"

    def _needed(self) -> set[int]:
        """The versions that workers may need: the newest, those that act in open rounds, and those that may meet them."""
        acting = {self.coordinator.version, *self.coordinator.rollouts.rounds.acting()}
        met = {each for version in acting for each in range(version - self.settings.opponents + 1, version) if each >= 0}
        return {*acting, *met, *_snapshots(self.coordinator)}

    def _gather(self) -> list[Outgoing]:
        """Begin to gather the rollouts of the next update."""
        out = self.coordinator.begin_update()
        opened = len(self.coordinator.rollouts.rounds._versions)
        assert opened == self.settings.max_lag + 1, (
            f"{Rule.OPEN_ROUNDS}: an update has begun and not all of its rounds are open"
        )
        return out + self._learn()

    def acts(self, number: int) -> int:
        """The version that must act in this round."""
        return max(0, number - self.settings.max_lag)

    def _checkpoint(self) -> list[Outgoing]:
        coordinator = self.coordinator
        incarnations = tuple(incarnation(lane, number) for lane, number in enumerate(coordinator.rollouts.incarnations()))
        accepted = tuple(_accepted(lane, number) for lane, (number, _, _) in enumerate(self.accepted))
        past = coordinator.past(coordinator.version)
        rounds = past.rounds.next, tuple(past.rounds.versions.items())
        places = tuple(map(_place, coordinator.rollouts.lanes))
        issued = ticket(coordinator.rollouts.ledger.issued)
        self.checkpoints.append((issued, coordinator.rollouts.ledger.used, incarnations, accepted, rounds, places))
        return []

    def _accept(self, arrived: AcceptedRollout) -> None:
        rollout = arrived.rollout
        number, collected_in, sequences = self.accepted[rollout.lane]
        assert arrived.incarnation >= number, f"{Rule.LANE_MOVES}: a lane went back to an earlier incarnation"
        if arrived.incarnation > number:
            sequences = set()
        else:
            assert collected_in == rollout.session, (
                f"{Rule.LANE_MOVES}: two sessions collected the same incarnation of a lane"
            )
        assert rollout.sequence not in sequences, f"{Rule.SEQUENCE}: a rollout was accepted twice"
        self.accepted[rollout.lane] = arrived.incarnation, rollout.session, sequences | {rollout.sequence}

    def _learn(self) -> list[Outgoing]:
        """Take the rollouts of an update, if there are enough."""
        if self.updating:
            return []
        coordinator, ledger = self.coordinator, self.coordinator.rollouts.ledger
        before, number = ledger.transitions_used, coordinator.rollouts.rounds.next
        taken = coordinator.rollouts.take()
        if taken is None:
            return []
        assert ledger.transitions_used - before == len(taken), "an update counted another number of transitions"
        for rollout in (arrived.rollout for arrived in taken):
            assert rollout.ticket not in self.used, f"{Rule.TICKET_NUMBERS}: a ticket was used twice"
            self.used.add(rollout.ticket)
            assert rollout.version == self.acts(number), (
                f"{Rule.ROUND_VERSION}: version {rollout.version} acted in round {number}, instead of {self.acts(number)}"
            )
            assert place_of(rollout.memory) == number + 1, (
                f"{Rule.PAST}: a rollout does not follow the one that its lane made in the round before"
            )
        lanes = [arrived.rollout.lane for arrived in taken]
        assert lanes == list(range(self.settings.lanes)), f"{Rule.ROUND}: an update has not one rollout of each lane"
        self.updating = True
        return []

    def check(self) -> None:
        """The rules that hold in every state."""
        check_tickets(self.coordinator, self.settings.max_lag)
        self._check_rounds()

    def _check_rounds(self) -> None:
        """Each lane has every open round once: due, with a worker, or waiting. A round acts as `lag_rule.py` says."""
        coordinator, rounds = self.coordinator, self.coordinator.rollouts.rounds
        opened = list(rounds._versions)
        assert opened == list(range(rounds.next, rounds.next + len(opened))), f"{Rule.OPEN_ROUNDS}: an open round is missing"
        assert len(opened) <= self.settings.max_lag + 1, f"{Rule.OPEN_ROUNDS}: more rounds are open than the lag allows"
        versions = {number: self.acts(number) for number in opened}
        assert rounds._versions == versions, (
            f"{Rule.ROUND_VERSION}: other weights act in a round than those that were the newest"
        )
        self._check_opponents()
        found = [(each.permit.lane, each.permit.round, each.version) for each in coordinator.rollouts.held.values()]
        for number, of_round in coordinator.rollouts.ready.items():
            found += [(lane, number, arrived.rollout.version) for lane, arrived in of_round.items()]
        found += [(lane.number, number, versions[number]) for lane in coordinator.rollouts.lanes for number in lane.due]
        every = [(lane.number, *of_round) for lane in coordinator.rollouts.lanes for of_round in versions.items()]
        assert sorted(found) == every, f"{Rule.OPEN_ROUNDS}: a lane does not have every open round once, under its version"
        for lane in coordinator.rollouts.lanes:
            permits = [ticket.permit for ticket in coordinator.rollouts.held.values()]
            mine = [(permit.round, permit.sequence) for permit in permits if permit.lane == lane.number]
            mine += [
                (number, of_round[lane.number].rollout.sequence)
                for number, of_round in coordinator.rollouts.ready.items()
                if lane.number in of_round and of_round[lane.number].incarnation == lane.incarnation
            ]
            in_order = [sequence for _, sequence in sorted(mine)]
            assert in_order == sorted(set(in_order)), (
                f"{Rule.IN_ORDER}: rollouts of a lane are not collected in the order of the rounds"
            )
            assert all(sequence < lane.dealt for sequence in in_order), (
                f"{Rule.SEQUENCE}: a sequence number will be dealt twice"
            )
        if coordinator.version >= 0:  # before, nobody has weights, also in a resumed run, whose rounds are known already
            assert self._needed().issubset(coordinator.weights.kept), "weights that are needed are dropped"

    def _check_opponents(self) -> None:
        """A version meets itself, or one of those before it: as many as play."""
        play = self.settings.opponents
        for each in self.coordinator.rollouts.held.values():
            met = range(max(0, each.version - play + 1), each.version + 1) if play else [None]
            assert each.permit.opponent in met, f"{Rule.OPPONENT}: a ticket names an opponent that does not play"


# -------------------------------------------------------------------- to tuples and back


def saved(learner: Learner, now: float) -> Content:
    coordinator = learner.coordinator
    learner.check()
    lanes, rounds = coordinator.rollouts.lanes, coordinator.rollouts.rounds
    tickets = [each for _, each in sorted(coordinator.rollouts.held.items())]
    waiting_for = coordinator._placement._waiting_for
    return (
        ticket(coordinator.rollouts.ledger.issued),
        coordinator.rollouts.ledger.used,
        coordinator.version,
        (rounds.next, tuple(rounds._versions.values()), tuple(rounds._saved.items())),
        tuple(_lane(lane) for lane in lanes),
        tuple(_ticket(each) for each in tickets),
        tuple(
            (number, rollout_content(each.rollout), incarnation(lane, each.incarnation))
            for number, of_round in sorted(coordinator.rollouts.ready.items())
            for lane, each in sorted(of_round.items())
        ),
        membership_part.saved(coordinator.membership, now),
        tuple(sorted(coordinator._placement._unplaced)),
        coordinator._placement._settled,
        None if waiting_for is None else (session(waiting_for.session), tuple(sorted(waiting_for.lanes))),
        tuple(sorted(coordinator.rollouts._to_deal)),
        (tuple(sorted(coordinator.weights.kept)), _held(coordinator)),
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


def _held(coordinator: TicketCoordinator) -> Content:
    """Which weights each member holds, in the order in which they joined, and what of it is not known for sure."""
    members = sorted(coordinator.members.values(), key=lambda each: each.join_number)
    by_worker = coordinator.weights.held.by_worker
    assert by_worker.keys() <= coordinator.members.keys(), "weights count as held by a worker that is gone"
    return tuple(
        tuple(
            (version, name(Kind.REPLIES, standing.replies, member.session) if isinstance(standing, SentAfter) else None)
            for version, standing in sorted(by_worker.get(member.peer, {}).items())
        )
        for member in members
    )


def _standing(sent_at: Name | None) -> Standing:
    return Confirmed() if sent_at is None else SentAfter(sent_at.value)


def _snapshots(coordinator: TicketCoordinator) -> list[int]:
    pool = coordinator.rollouts.opponents
    return [] if pool is None else pool.versions


def _accepted(lane: int, number: int) -> Name | None:
    return None if number < 0 else incarnation(lane, number)


def _worker(number: int) -> Name:
    return name(Kind.WORKER, number)


def _place(lane: TicketedLane) -> int | None:
    """How many rollouts its env copies had made when the last one was taken; None: none was."""
    return None if lane.history is None else place_of(lane.history.memory)


def _histories(places: Content) -> LaneHistories:
    """Those of lanes at these places."""
    pasts = [fake_past(lane, place) for lane, place in enumerate(places) if place is not None]
    return LaneHistories(1, MOST_STEPS, pasts)


def _lane(lane: TicketedLane) -> Content:
    owner = None if lane.owner is None else _worker(worker_of(lane.owner))
    number = incarnation(lane.number, lane.incarnation)
    out_of_order = tuple(sorted(lane.out_of_order))
    return number, owner, lane.moving, tuple(lane.due), lane.dealt, lane.next_sequence, out_of_order, _place(lane)


def _ticket(each: Ticket) -> Content:
    return fields_of(each.permit), each.version, _worker(worker_of(each.peer))


def without_checkpoints(content: Content) -> Content:
    return (*content[:14], (), *content[15:])


def loaded(content: Content, settings: Settings) -> Learner:
    """A learner at the time 0 with this content."""
    issued, used, version, (next_round, versions, to_open), lanes, tickets, ready, members, *rest = content
    unplaced, settled, waiting_for, to_deal, (kept, held), *mine = rest
    coordinator = TicketCoordinator(
        settings.run,
        RolloutDealer(
            settings.run.lanes,
            Rounds(settings.max_lag, next_round, dict(to_open)),
            ledger=Ledger(issued=issued.value, used=used, lost=issued.value - used - len(tickets) - len(ready)),
            opponents=settings.pool(version),
            histories=_histories(tuple(lane[-1] for lane in lanes)),
        ),
        worker_timeout_s=TIMEOUT_S,
        first_session=members[1].value,
        check_rows=any_rows,
    )
    coordinator.version = version
    coordinator.rollouts.ledger.transitions_received = len(ready)
    coordinator.rollouts.rounds._versions = dict(enumerate(versions, next_round))
    coordinator.rollouts._to_deal = set(to_deal)
    coordinator.weights.kept = {each: weights(each) for each in kept}
    for of_round, fields, number in ready:
        arrived = AcceptedRollout(rollout_of(fields), number.value)
        coordinator.rollouts.ready.setdefault(of_round, {})[arrived.rollout.lane] = arrived
    for lane, (number, owner, moving, due, dealt, following, out_of_order, _) in zip(
        coordinator.rollouts.lanes, lanes, strict=True
    ):
        lane.incarnation, lane.owner = number.value, None if owner is None else peer_of(owner.value)
        lane.moving, lane.due, lane.dealt = moving, list(due), dealt
        lane.next_sequence, lane.out_of_order = following, set(out_of_order)
    for fields, under, worker in tickets:
        permit, peer = record_of(Permit, fields), peer_of(worker.value)
        coordinator.rollouts.held[permit.ticket] = Ticket(permit, under, peer)
    membership_part.load(coordinator.membership, members)
    for number, each in coordinator.rollouts.held.items():
        of_member = coordinator.members[each.peer].tickets
        of_member[number] = of_member[number]._replace(versions=each.versions)
    for peer, by_version in zip(coordinator.members, held, strict=True):  # in the order in which they joined
        standings = {version: _standing(sent_at) for version, sent_at in by_version}
        coordinator.weights.held.by_worker[peer] = standings
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


def _waiting_for(coordinator: TicketCoordinator, number: Name, lanes: Content) -> Member:
    for member in coordinator.members.values():
        if member.session == number.value:
            return member
    gone = Member(b"gone", hello(0, 0, 1), number.value, 0, 0.0)  # it left, and placement still refers to it
    gone.lanes = set(lanes)
    return gone


L = TypeVar("L", bound=Learner)


def first_learner(settings: Settings, kind: type[L]) -> tuple[L, list[Outgoing]]:
    """A learner of this kind that starts a run."""
    before = kind(
        settings,
        TicketCoordinator(
            settings.run,
            RolloutDealer(settings.run.lanes, Rounds(settings.max_lag), histories=_histories(())),
            worker_timeout_s=TIMEOUT_S,
            first_session=0,
            check_rows=any_rows,
        ),
    )
    none = tuple(incarnation(lane, 0) for lane in range(settings.lanes))
    before.checkpoints = [(ticket(0), 0, none, (None,) * settings.lanes, (0, ()), (None,) * settings.lanes)]
    return before.restarted(0)
