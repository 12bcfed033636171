"""Each rule of the learner's half of the conversation, by name. Pure: the test is the workers, time is a number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeVar

import msgspec
import numpy as np
import pytest

from millrace.learner.config.validation import MOST_TICKETS
from millrace.learner.members.events import (
    EnvironmentNoted,
    EnvironmentRaised,
    Failed,
    NamelessHello,
    PolicyRaised,
    RolloutArrived,
    RolloutRejected,
    WorkerJoined,
    WorkerLeft,
    WorkerRefused,
    describe,
)
from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan, PendingEvaluation
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.lane_history import LaneHistories
from millrace.learner.rollouts.lanes import TicketedLane
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.rollouts.past_rollouts import packed
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout, RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import MOST_NOTES, STRIKES, TicketCoordinator
from millrace.protocol.lane_past import EpisodeBegin
from millrace.protocol.messages import (
    PROTOCOL_VERSION,
    Collect,
    Described,
    Drain,
    Evaluate,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    LaneIncarnation,
    Permit,
    Received,
    Refuse,
    Rejoin,
    Release,
    Returned,
    Rollout,
    Stepped,
    ToLearner,
    Weights,
    Welcome,
    WorkerExit,
)
from millrace.protocol.rollout import Episode
from millrace.protocol.specs import OwnPolicySpec
from millrace.protocol.wire.codec import decode_to_worker, encode
from tests.support.conversation.every_message import to_learner
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import (
    BUFFERS,
    PARAMETERS,
    fake_memory,
    fake_rollout,
    process_ends,
    run_spec,
    spoiled,
)
from tests.support.conversation.rules import check_ledger, pending_evaluation

M = TypeVar("M")
A, B, C = b"a", b"b", b"c"
NOT_FINITE = "reward: expected finite values, got nan at step 0, copy 0"  # so are rollouts spoiled
TIMEOUT_S = 5.0


class Learner:
    """A coordinator, and shorthand for what workers say to it. Every call checks that the ledger balances."""

    def __init__(
        self,
        lanes: int = 2,
        max_lag: int = 0,
        ledger: Ledger | None = None,
        incarnations: Sequence[int] = (),
        publish: bool = True,
        rounds: Rounds | None = None,
        **run: object,
    ) -> None:
        """`run`: what differs from the smallest run."""
        self.coordinator = TicketCoordinator(
            run_spec(lanes, **run),
            RolloutDealer(lanes, rounds or Rounds(max_lag), ledger=ledger, incarnations=incarnations),
            worker_timeout_s=TIMEOUT_S,
            first_session=100,
        )
        self.now = 0.0
        if publish:
            self.publish(0)

    @property
    def evaluation(self) -> PendingEvaluation:
        """The evaluation that is pending."""
        return pending_evaluation(self.coordinator)

    def publish(self, version: int) -> list[Outgoing]:
        """New weights, with which the next update begins."""
        self.coordinator.publish(version, PARAMETERS, BUFFERS)
        return self.balanced(self.coordinator.begin_update())

    def says(self, peer: bytes, message: ToLearner) -> list[Outgoing]:
        return self.balanced(self.coordinator.receive(peer, message, self.now))

    def joins(self, peer: bytes, *, pid: int = 1, attempt: int = 1, host: str = "host") -> list[Outgoing]:
        nonce = 1000 * len(host) + pid
        return self.says(
            peer, example(Hello, worker=peer.decode(), host=host, pid=pid, process_nonce=nonce, attempt=nonce + attempt)
        )

    def session(self, peer: bytes) -> int:
        return self.coordinator.members[peer].session

    def tickets(self, peer: bytes | None = None) -> list[int]:
        """Numbers of the tickets that are with this worker, or with any."""
        return sorted(number for number, ticket in self.coordinator.rollouts.held.items() if peer in (None, ticket.peer))

    def rollout_of(self, number: int, sequence: int | None = None, version: int | None = None) -> Rollout:
        """The rollout of an outstanding ticket, as its worker would send it."""
        ticket = self.coordinator.rollouts.held[number]
        return fake_rollout(
            self.session(ticket.peer),
            ticket.permit.lane,
            number,
            ticket.version if version is None else version,
            ticket.permit.sequence if sequence is None else sequence,
        )

    def delivers(self, number: int) -> list[Outgoing]:
        return self.says(self.coordinator.rollouts.held[number].peer, self.rollout_of(number))

    def deliver_all(self) -> None:
        for number in self.tickets():
            self.delivers(number)

    def deliver_round(self) -> None:
        """What the next update still needs."""
        tickets = self.coordinator.rollouts.held.items()
        oldest = min(ticket.permit.round for _, ticket in tickets)
        for number in [number for number, ticket in tickets if ticket.permit.round == oldest]:
            self.delivers(number)

    def beats(
        self,
        peer: bytes,
        *,
        versions: Sequence[int] | None = None,
        tickets: Sequence[int] | None = None,
        replies: int | None = None,
    ) -> list[Outgoing]:
        """A Heartbeat: by default of a worker that lost nothing."""
        held = self.tickets(peer) if tickets is None else tickets
        member = self.coordinator.members[peer]
        seen = member.replies if replies is None else replies
        weights = sorted(self.holds(peer)) if versions is None else versions
        return self.says(
            peer, example(Heartbeat, session=self.session(peer), replies=seen, versions=tuple(weights), tickets=tuple(held))
        )

    def holds(self, peer: bytes) -> set[int]:
        """The versions that this worker holds or is about to get."""
        return set(self.coordinator.weights.held.versions(peer))

    def take(self) -> list[Rollout]:
        taken = self.coordinator.rollouts.take()
        assert taken is not None
        self.balanced([])
        return [arrived.rollout for arrived in taken]

    def update(self) -> list[Rollout]:
        """A whole synchronous update: everything delivered, taken, published."""
        self.deliver_all()
        taken = self.take()
        self.publish(self.coordinator.version + 1)
        return taken

    def update_round(self, version: int) -> list[Rollout]:
        """An update of the oldest round; then this version is published."""
        self.deliver_round()
        taken = self.take()
        self.publish(version)
        return taken

    def balanced(self, outs: list[Outgoing]) -> list[Outgoing]:
        check_ledger(self.coordinator)
        return outs


def of(outs: Sequence[Outgoing], kind: type[M], peer: bytes | None = None) -> list[M]:
    """The messages of this kind, to this worker or to any."""
    return [message for to, message in outs if isinstance(message, kind) and peer in (None, to)]


def permits(outs: Sequence[Outgoing], peer: bytes | None = None) -> list[Permit]:
    return [permit for collect in of(outs, Collect, peer) for permit in collect.permits]


def kinds(outs: Sequence[Outgoing], peer: bytes) -> list[type]:
    return [type(message) for to, message in outs if to == peer]


def lanes_of(learner: Learner, peer: bytes) -> set[int]:
    return learner.coordinator.members[peer].lanes


# -------------------------------------------------------------------- joining


def test_hello_is_answered_by_welcome_collect_and_weights_in_this_order() -> None:
    learner = Learner(lanes=2)
    outs = learner.joins(A)
    assert kinds(outs, A) == [Welcome, Collect, Weights]
    assert of(outs, Welcome) == [Welcome(100, 4_002, learner.coordinator.run)]
    assert learner.coordinator.events == [WorkerJoined("a", "host", 1)]


def test_before_the_first_weights_a_worker_is_welcomed_and_given_nothing() -> None:
    learner = Learner(publish=False)
    for peer in (A, B):
        ((to, welcome),) = learner.joins(peer)  # lanes are placed when all are here, and do not move from one to the next
        assert (to, type(welcome)) == (peer, Welcome)
    assert learner.coordinator.rollouts.ledger.issued == 0
    outs = learner.publish(0)
    assert kinds(outs, A) == kinds(outs, B) == [Collect, Weights]


def test_a_repeated_hello_is_answered_by_the_same_welcome() -> None:
    learner = Learner()
    first = of(learner.joins(A), Welcome)
    again = learner.joins(A)
    assert again == [(A, first[0])]
    assert learner.coordinator.rollouts.ledger.lost == 0


def test_a_later_attempt_of_the_same_process_begins_a_new_session() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    outs = learner.joins(A, attempt=2)
    assert of(outs, Welcome) == [Welcome(101, 4_003, learner.coordinator.run)]
    assert learner.coordinator.rollouts.ledger.lost == 2
    assert {permit.incarnation for permit in permits(outs)} == {1}


def test_a_late_hello_of_an_earlier_attempt_is_ignored() -> None:
    learner = Learner()
    learner.joins(A, attempt=2)
    assert learner.joins(A, attempt=1) == []
    assert learner.session(A) == 100


@pytest.mark.parametrize(("pid", "host"), [(2, "host"), (1, "elsewhere")])
def test_the_same_name_from_another_process_replaces_the_old_one(pid: int, host: str) -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    outs = learner.joins(A, pid=pid, host=host)
    assert kinds(outs, A) == [Welcome, Collect, Weights]
    assert learner.session(A) == 101
    assert learner.coordinator.rollouts.ledger.lost == 2
    assert WorkerLeft("a", f"replaced by process {pid}", 2, False) in learner.coordinator.events


def test_a_process_that_was_replaced_joins_again_but_two_do_not_take_a_name_from_each_other_for_ever() -> None:
    learner = Learner(lanes=1)
    for pid, attempt in ((1, 1), (1, 2), (2, 1), (1, 3), (2, 2)):  # who joins again takes its name from nobody
        assert kinds(learner.joins(A, pid=pid, attempt=attempt), A) == [Welcome, Collect, Weights]
    (refuse,) = of(learner.joins(A, pid=1, attempt=4), Refuse)
    assert "give each worker a name of its own" in refuse.reason
    assert learner.coordinator.members[A].hello.pid == 2


def test_a_name_that_is_not_the_routing_id_is_refused() -> None:
    learner = Learner()
    (refuse,) = of(learner.says(A, example(Hello, worker="b", process_nonce=1001)), Refuse)
    assert "routing id" in refuse.reason
    assert learner.coordinator.members == {}


def test_a_hello_over_a_connection_without_a_routing_id_is_refused_with_what_a_client_must_set() -> None:
    learner = Learner()
    (refuse,) = of(learner.says(b"\0\0\0\0\1", example(Hello, worker="b", process_nonce=1001)), Refuse)
    assert refuse.reason.startswith("its connection has no routing id: expected the worker's name, set as the socket's")
    assert [type(event) for event in learner.coordinator.events] == [NamelessHello]


def test_another_protocol_is_refused_and_says_what_to_do() -> None:
    learner = Learner()
    outs = learner.says(A, example(Hello, protocol=PROTOCOL_VERSION + 1, worker="a", process_nonce=1001))
    (refuse,) = of(outs, Refuse)
    assert f"expected {PROTOCOL_VERSION}, got {PROTOCOL_VERSION + 1}" in refuse.reason
    assert learner.coordinator.members == {}
    assert isinstance(learner.coordinator.events[0], WorkerRefused)


@pytest.mark.parametrize("known", [False, True], ids=["unknown worker", "earlier session"])
def test_a_message_of_no_session_of_ours_is_answered_by_rejoin(known: bool) -> None:
    learner = Learner()
    if known:
        learner.joins(A)
    for message in (example(Heartbeat, session=5, versions=(0,)), fake_rollout(5, 0, 0, 0, 0)):
        assert learner.says(A, message) == [(A, Rejoin(5))]


def test_a_last_word_of_no_session_of_ours_is_not_answered() -> None:
    learner = Learner()
    learner.joins(A)
    assert learner.says(A, Goodbye(5, "bye", ())) == learner.says(A, example(Failure, session=5, error="broke")) == []
    assert A in learner.coordinator.members


# -------------------------------------------------------------------- the ticket law


@pytest.mark.parametrize("max_lag", [0, 1, 4])
@pytest.mark.parametrize("lanes", [1, 2, 4])
def test_every_lane_has_a_ticket_for_every_open_round_and_no_other(max_lag: int, lanes: int) -> None:
    """Rule: once update u has begun, the rounds up to u + max_lag are open."""
    learner = Learner(lanes, max_lag)
    learner.joins(A)
    coordinator = learner.coordinator
    for update in range(5):
        open_rounds = {(number, lane) for number in range(update, update + max_lag + 1) for lane in range(lanes)}
        dealt = {(ticket.permit.round, ticket.permit.lane) for ticket in coordinator.rollouts.held.values()}
        assert dealt == open_rounds
        assert coordinator.begin_update() == []  # it has begun
        learner.deliver_round()
        assert len(coordinator.rollouts.held) == lanes * max_lag
        learner.take()
        learner.publish(update + 1)


@pytest.mark.parametrize("max_lag", [0, 1, 3])
def test_update_u_acts_under_the_weights_that_were_the_newest_when_update_u_minus_max_lag_began(max_lag: int) -> None:
    """Numbers of versions mean nothing: two of three are never the newest when an update begins."""
    learner = Learner(lanes=2, max_lag=max_lag)
    learner.joins(A)
    newest = [3 * update for update in range(8)]
    for update in range(8):
        learner.deliver_round()
        assert {rollout.version for rollout in learner.take()} == {newest[max(0, update - max_lag)]}
        learner.coordinator.publish(3 * update + 2, PARAMETERS, BUFFERS)
        learner.publish(3 * update + 3)


def test_an_update_without_new_weights_acts_under_those_there_are() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.update()
    learner.deliver_all()
    assert [rollout.version for rollout in learner.take()] == [1]
    assert of(learner.coordinator.begin_update(), Weights) == []
    learner.deliver_all()
    assert [rollout.version for rollout in learner.take()] == [1]


def test_an_update_takes_its_rollouts_in_the_order_of_lanes_whichever_comes_first() -> None:
    learner = Learner(lanes=3)
    learner.joins(A)
    for number in (2, 0, 1):
        assert learner.coordinator.rollouts.take() is None, "a lane lacks its rollout"
        learner.delivers(number)
    assert [rollout.lane for rollout in learner.take()] == [0, 1, 2]


def test_the_round_of_a_lost_ticket_is_dealt_again_under_its_version() -> None:
    learner = Learner(lanes=2, max_lag=1)
    learner.joins(A)
    learner.deliver_round()
    learner.take()
    learner.publish(1)
    tickets = learner.coordinator.rollouts.held.items()
    lost = next(number for number, ticket in tickets if ticket.permit.round == 1 and ticket.permit.lane == 0)
    outs = learner.says(A, spoiled(learner.rollout_of(lost)))
    (permit,) = permits(outs)
    again = learner.coordinator.rollouts.held[permit.ticket]
    assert (permit.lane, permit.round, again.version, permit.sequence) == (0, 1, 0, 3)  # two and one of round 2 were dealt


def test_in_a_synchronous_run_no_lane_gets_two_tickets_in_a_round_while_another_is_moving() -> None:
    """A worker leaves and a newcomer comes in mid-round: the round is finished by the lanes that it began with."""
    learner = Learner(lanes=3)
    learner.joins(A)
    learner.delivers(learner.tickets()[0])  # lane 0 is done with its round
    learner.joins(B)  # a lane moves to B, at a rollout boundary
    round_lanes = [
        *learner.coordinator.rollouts.ready[0],
        *(ticket.permit.lane for ticket in learner.coordinator.rollouts.held.values()),
    ]
    assert sorted(round_lanes) == [0, 1, 2]
    learner.says(A, Goodbye(learner.session(A), "bye", ()))
    round_lanes = [
        *learner.coordinator.rollouts.ready[0],
        *(ticket.permit.lane for ticket in learner.coordinator.rollouts.held.values()),
    ]
    assert sorted(round_lanes) == [0, 1, 2]


def test_a_lane_that_is_to_move_finishes_what_it_was_dealt_and_the_others_go_on() -> None:
    learner = Learner(lanes=3, max_lag=1)
    learner.joins(A)
    learner.joins(B)
    (moving,) = [lane.number for lane in learner.coordinator.rollouts.lanes if lane.moving]
    learner.deliver_round()
    learner.take()
    dealt = {permit.lane for permit in permits(learner.publish(1))}
    assert dealt == {0, 1, 2} - {moving}
    (last,) = [number for number, ticket in learner.coordinator.rollouts.held.items() if ticket.permit.lane == moving]
    outs = learner.delivers(last)
    (permit,) = permits(outs, B)
    assert (permit.lane, permit.incarnation, permit.sequence) == (moving, 1, 0)
    assert [collect.version for collect in of(outs, Collect, B)] == [1]


def test_a_lane_that_is_to_move_moves_when_its_last_rollout_is_bad() -> None:
    """Else nobody would collect its round."""
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.joins(B)
    (moving,) = [lane.number for lane in learner.coordinator.rollouts.lanes if lane.moving]
    (last,) = [number for number, ticket in learner.coordinator.rollouts.held.items() if ticket.permit.lane == moving]
    outs = learner.says(A, spoiled(learner.rollout_of(last)))
    assert [permit.lane for permit in permits(outs, B)] == [moving]


def test_rounds_of_lost_tickets_are_dealt_again_in_their_order() -> None:
    learner = Learner(lanes=1, max_lag=2)
    learner.joins(A)
    learner.says(A, spoiled(learner.rollout_of(0)))  # its round has the last ticket now
    process_ends(learner.coordinator, "a", "killed")
    learner.joins(B)
    held = learner.coordinator.rollouts.held
    assert [held[number].permit.round for number in learner.tickets(B)] == [0, 1, 2]


def test_when_every_worker_is_lost_no_ticket_is_dealt_until_one_joins() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    assert learner.balanced(process_ends(learner.coordinator, "a", "killed")) == []
    assert learner.coordinator.begin_update() == []
    outs = learner.joins(B)
    assert {(permit.lane, permit.incarnation) for permit in permits(outs)} == {(0, 1), (1, 1)}


def test_a_ticket_is_used_once_and_a_repeat_is_counted() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    rollout = learner.rollout_of(0)
    learner.says(A, rollout)
    learner.says(A, rollout)
    assert [r.ticket for r in learner.take()] == [0]
    learner.says(A, rollout)
    ledger = learner.coordinator.rollouts.ledger
    assert (ledger.used, ledger.transitions_used, ledger.transitions_duplicate) == (1, 1, 2)


def test_a_late_rollout_of_an_ended_session_is_counted_and_answered_by_rejoin() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    rollout = learner.rollout_of(0)
    process_ends(learner.coordinator, "a", "killed")
    assert learner.says(A, rollout) == [(A, Rejoin(100))]
    assert (learner.coordinator.rollouts.ledger.transitions_late, learner.coordinator.rollouts.ready) == (1, {})


@pytest.mark.parametrize("change", [{"version": 0}, {"version": 2}, {"lane": 1}, {"sequence": 0}, {"sequence": 2}])
def test_a_rollout_that_does_not_fit_its_ticket_is_not_used_and_dealt_again(change: dict[str, int]) -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.update()
    number, other = learner.tickets()
    ticket = learner.coordinator.rollouts.held[number]
    assert ticket.version == ticket.permit.sequence == 1
    outs = learner.says(A, msgspec.structs.replace(learner.rollout_of(number), **change))
    ledger = learner.coordinator.rollouts.ledger
    assert (learner.coordinator.rollouts.ready, ledger.transitions_invalid, ledger.lost) == ({}, 1, 1)
    assert permits(outs) == [example(Permit, ticket=other + 1, sequence=2, round=1)]
    assert learner.coordinator.members[A].strikes == 1


@pytest.mark.parametrize(("length", "accepted"), [(301, True), (302, False)])
def test_an_episode_may_be_as_long_as_all_env_steps_before_a_resume_and_those_since(length: int, accepted: bool) -> None:
    """Three rollouts of 100 env steps were used, and rollouts have one env step now."""
    used = Ledger(issued=3, used=3, transitions_received=300, transitions_used=300)
    learner = Learner(lanes=1, ledger=used, rounds=Rounds(0, next_round=3))
    learner.joins(A)
    ended = {"terminated": np.ones((1, 1), bool), "episodes": (Episode(1.0, length, 1.0),)}
    learner.says(A, msgspec.structs.replace(learner.rollout_of(3), **ended))
    assert (learner.coordinator.rollouts.take() is not None) == accepted


def test_a_rollout_of_another_workers_ticket_is_not_used_and_costs_that_worker_nothing() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.joins(B)
    learner.update()
    (theirs,) = learner.tickets(B)
    learner.says(A, msgspec.structs.replace(learner.rollout_of(theirs), session=learner.session(A)))
    assert learner.coordinator.rollouts.ready == {}
    assert learner.tickets(B) == [theirs]
    assert (learner.coordinator.members[A].strikes, learner.coordinator.members[B].strikes) == (1, 0)


# -------------------------------------------------------------------- lanes


def test_a_lost_workers_tickets_and_lanes_are_dealt_to_the_living_with_a_higher_incarnation() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.joins(B)
    learner.update()
    (lost,) = learner.tickets(A)
    lane = learner.coordinator.rollouts.held[lost].permit.lane
    before = learner.coordinator.rollouts.lanes[lane].incarnation
    outs = learner.balanced(process_ends(learner.coordinator, "a", "killed"))
    assert [(p.lane, p.incarnation) for p in permits(outs, B)] == [(lane, before + 1)]
    assert lost not in learner.coordinator.rollouts.held
    assert lanes_of(learner, B) == {0, 1}


def test_a_new_life_of_a_lane_has_received_nothing() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.update()
    learner.joins(B)
    outs = process_ends(learner.coordinator, "a", "killed")
    (collect,) = of(outs, Collect, B)
    assert collect.received == (Received(0, 1, 0, ()),)


def test_a_lane_that_was_never_started_keeps_its_incarnation_when_moved() -> None:
    learner = Learner(lanes=2, publish=False)
    learner.coordinator.publish(0, PARAMETERS, BUFFERS)
    learner.joins(A)
    learner.coordinator.begin_evaluation(EvaluationPlan((1,), copies=1, most_steps=2))
    learner.joins(B)
    assert (lanes_of(learner, A), lanes_of(learner, B)) == ({0}, {1})
    learner.coordinator.evaluation.end()
    assert {(permit.lane, permit.incarnation) for permit in permits(learner.publish(0))} == {(0, 0), (1, 0)}


def test_lanes_even_out_to_a_newcomer_only_at_a_rollout_boundary() -> None:
    learner = Learner(lanes=4)
    learner.joins(A)
    assert of(learner.joins(B), Release) == []  # every lane is in the middle of a rollout
    assert lanes_of(learner, B) == set()
    outs = learner.delivers(3)  # lane 3 is at its boundary
    assert of(outs, Release, A) == [Release(learner.session(A), (LaneIncarnation(3, 0),))]
    assert lanes_of(learner, B) == {3}
    assert learner.coordinator.rollouts.lanes[3].incarnation == 1
    learner.update()
    assert len(lanes_of(learner, A)) == len(lanes_of(learner, B)) == 2
    assert learner.coordinator.rollouts.ledger.lost == 0


def test_release_travels_before_what_the_lanes_new_owner_is_told() -> None:
    learner = Learner(lanes=2, max_lag=1)  # two rounds are open
    learner.joins(A)
    learner.joins(B)
    learner.deliver_round()
    learner.take()
    learner.publish(1)
    (last,) = [number for number, ticket in learner.coordinator.rollouts.held.items() if ticket.permit.lane == 1]
    outs = learner.delivers(last)  # lane 1 has nothing outstanding any more: it moves, and is dealt a ticket at once
    assert [type(message) for _, message in outs] == [Release, Collect, Weights]
    assert [permit.lane for permit in permits(outs, B)] == [1]


def test_a_newcomer_takes_from_the_fullest() -> None:
    learner = Learner(lanes=6)
    for peer in (A, B):
        learner.joins(peer)
        learner.update()
    learner.joins(C)
    learner.update()
    assert [len(lanes_of(learner, peer)) for peer in (A, B, C)] == [2, 2, 2]


def test_more_workers_than_lanes_stand_by() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.joins(B)
    learner.update()
    assert (lanes_of(learner, A), lanes_of(learner, B)) == ({0}, set())


def test_a_lane_has_one_owner_whoever_comes_and_goes() -> None:
    learner = Learner(lanes=5)
    for step, peer in enumerate([A, B, C, A, B, A, C, B] * 4):
        if peer in learner.coordinator.members and step % 3:
            learner.balanced(process_ends(learner.coordinator, peer.decode(), "killed"))
        else:
            learner.joins(peer, pid=step)
        if learner.coordinator.members:
            learner.update()
            owned = [n for member in learner.coordinator.members.values() for n in member.lanes]
            assert sorted(owned) == [0, 1, 2, 3, 4]
            assert all(
                learner.coordinator.rollouts.lanes[n].owner == m.peer
                for m in learner.coordinator.members.values()
                for n in m.lanes
            )


# -------------------------------------------------------------------- weights


def test_weights_are_sent_after_the_first_order_that_names_them_and_once() -> None:
    learner = Learner(lanes=2, max_lag=1)
    assert [weights.version for weights in of(learner.joins(A), Weights)] == [0]
    for version in (1, 2, 3):
        learner.deliver_round()
        learner.take()
        outs = learner.publish(version)
        assert kinds(outs, A) == [Collect, Weights]
        assert [weights.version for weights in of(outs, Weights)] == [version]
        assert of(learner.beats(A), Weights) == []


def test_a_worker_that_nothing_asks_for_gets_no_weights_until_something_does() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    assert kinds(learner.joins(B), B) == [Welcome]
    learner.update()
    outs = learner.balanced(process_ends(learner.coordinator, "a", "killed"))
    assert kinds(outs, B) == [Collect, Weights]
    assert [weights.version for weights in of(outs, Weights, B)] == [1]


def test_a_lane_that_moves_takes_the_weights_of_its_rounds_along() -> None:
    """Two rounds are open, under versions 0 and 1: its new owner has neither."""
    learner = Learner(lanes=1, max_lag=1)
    learner.joins(A)
    learner.joins(B)
    learner.update_round(1)
    outs = learner.balanced(process_ends(learner.coordinator, "a", "killed"))
    assert [collect.version for collect in of(outs, Collect, B)] == [0, 1]
    assert [weights.version for weights in of(outs, Weights, B)] == [0, 1]


def test_weights_that_act_in_no_open_round_are_not_kept() -> None:
    learner = Learner(lanes=1, max_lag=2)
    learner.joins(A)
    for version in range(1, 9):
        learner.update_round(version)
        assert len(learner.coordinator.weights.kept) <= 4  # one for each open round, and the newest
        assert len(learner.holds(A)) <= 4


def test_one_weights_is_said_to_all_so_that_it_is_encoded_once() -> None:
    learner = Learner(lanes=2, publish=False)
    for peer in (A, B):
        learner.joins(peer)
    first, second = of(learner.publish(0), Weights)
    assert first is second


# -------------------------------------------------------------------- what travels together


def test_what_is_dealt_together_travels_together() -> None:
    learner = Learner(lanes=4)
    (collect,) = of(learner.joins(A), Collect)
    assert [permit.lane for permit in collect.permits] == [0, 1, 2, 3]
    learner.joins(B)
    learner.update()
    learner.deliver_all()
    learner.take()
    outs = learner.publish(2)
    assert len(of(outs, Collect, A)) == len(of(outs, Collect, B)) == 1


def test_collect_says_what_has_arrived_of_every_lane_of_the_worker() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.deliver_all()
    learner.take()
    (collect,) = of(learner.publish(1), Collect)
    assert collect.received == (Received(0, 0, 1, ()), Received(1, 0, 1, ()))


def test_a_rollout_that_came_before_an_earlier_one_is_said_to_be_ahead() -> None:
    learner = Learner(lanes=1, max_lag=1)
    learner.joins(A)
    learner.says(A, learner.rollout_of(1, sequence=1))
    (reply,) = of(learner.beats(A), HeartbeatReply)
    assert reply.received == (Received(0, 0, 0, (1,)),)
    learner.says(A, learner.rollout_of(0, sequence=0))
    (reply,) = of(learner.beats(A), HeartbeatReply)
    assert reply.received == (Received(0, 0, 2, ()),)


# -------------------------------------------------------------------- the heartbeat repairs


def test_a_heartbeat_is_answered_and_replies_are_numbered() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    for number in (1, 2, 3):
        assert of(learner.beats(A), HeartbeatReply) == [HeartbeatReply(100, number, (Received(0, 0, 0, ()),))]


def test_a_lost_collect_is_said_again_only_when_a_reply_said_after_it_has_been_seen() -> None:
    learner = Learner(lanes=1)
    (first,) = of(learner.joins(A), Collect)
    assert of(learner.beats(A, tickets=[], replies=0), Collect) == []  # it may still be on its way
    assert of(learner.beats(A, tickets=[], replies=1), Collect) == [first]
    assert of(learner.beats(A, tickets=[], replies=1), Collect) == []  # the repeat may be on its way
    assert of(learner.beats(A, tickets=[], replies=2), Collect) == [first]  # reply 2 was said after it
    assert of(learner.beats(A, tickets=[0]), Collect) == []
    assert learner.coordinator.rollouts.ledger.issued == 1


def test_a_lost_order_to_evaluate_and_its_weights_are_said_again_only_when_a_reply_said_after_them_has_been_seen() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.deliver_all()
    learner.take()
    learner.coordinator.publish(1, PARAMETERS, BUFFERS)
    outs = learner.coordinator.begin_evaluation(EvaluationPlan(seeds=(1,), copies=1, most_steps=10))
    assert kinds(outs, A) == [Evaluate, Weights]
    (order,) = of(outs, Evaluate)
    for replies, again in ((0, 0), (1, 1), (1, 0), (2, 1)):
        outs = learner.beats(A, versions=[0], tickets=[], replies=replies)
        assert of(outs, Evaluate) == [order] * again
        assert [weights.version for weights in of(outs, Weights)] == [1] * again
    assert of(learner.beats(A, versions=[0], tickets=[order.ticket]), Weights) != []


def test_lost_weights_are_said_again_only_when_a_reply_said_after_them_has_been_seen() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    assert of(learner.beats(A, versions=[], replies=0), Weights) == []
    assert [weights.version for weights in of(learner.beats(A, versions=[], replies=1), Weights)] == [0]
    assert of(learner.beats(A, versions=[], replies=1), Weights) == []
    assert len(of(learner.beats(A, versions=[], replies=2), Weights)) == 1


def test_weights_that_a_worker_has_dropped_are_sent_again_with_the_next_order_that_names_them() -> None:
    learner = Learner(lanes=2, max_lag=1)
    learner.joins(A)
    learner.joins(B)
    for version in (1, 2):
        learner.update_round(version)
    assert lanes_of(learner, A) == {0}  # the other lane lives with B
    learner.delivers(learner.tickets(A)[0])
    learner.beats(A)
    learner.beats(A, versions=[2])
    outs = learner.balanced(process_ends(learner.coordinator, "b", "killed"))  # its rounds are under versions 1 and 2
    assert [collect.version for collect in of(outs, Collect, A)] == [1, 2]
    assert [weights.version for weights in of(outs, Weights, A)] == [1]


def test_a_worker_gets_no_weights_for_the_ticket_of_another() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.joins(B)
    assert of(learner.beats(A, versions=[], tickets=[0], replies=1), Weights) != [], "they were lost on the way"
    assert of(learner.beats(B, versions=[], tickets=[0], replies=1), Weights) == []


def test_weights_that_only_finished_tickets_name_are_not_said_again() -> None:
    """Its worker has dropped them."""
    learner = Learner(lanes=1, max_lag=1)
    learner.joins(A)
    learner.update_round(1)
    old, new = learner.tickets()
    learner.beats(A)
    outs = learner.beats(A, versions=[1], tickets=[old, new])  # it has the ticket, and lost the weights
    assert [weights.version for weights in of(outs, Weights)] == [0]
    learner.delivers(old)
    assert of(learner.beats(A, versions=[1], tickets=[new]), Weights) == []
    assert of(learner.beats(A, versions=[1], tickets=[new]), Weights) == []


def test_a_lost_rollout_is_asked_for_again() -> None:
    """Its worker holds the ticket no more, and the learner has not got it: the same Collect brings it back."""
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.beats(A)
    outs = learner.beats(A, tickets=[1])
    assert permits(outs) == [example(Permit)]
    assert learner.coordinator.rollouts.ledger.lost == 0


def test_lost_collects_of_several_versions_are_said_again_each_under_its_own() -> None:
    learner = Learner(lanes=1, max_lag=2)
    learner.joins(A)
    learner.update_round(1)
    learner.beats(A)
    collects = of(learner.beats(A, tickets=[]), Collect)
    assert [(collect.version, [p.ticket for p in collect.permits]) for collect in collects] == [(0, [1, 2]), (1, [3])]


def test_what_is_said_again_travels_before_the_reply() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.beats(A)
    assert kinds(learner.beats(A, versions=[], tickets=[0]), A) == [Weights, Collect, HeartbeatReply]


def test_a_reply_leaves_out_lanes_that_live_elsewhere() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.joins(B)
    learner.deliver_all()
    for peer in (A, B):
        (reply,) = of(learner.beats(peer), HeartbeatReply)
        assert {received.lane for received in reply.received} == lanes_of(learner, peer)
        assert len(reply.received) == 1


# -------------------------------------------------------------------- rubbish


def test_a_bad_rollout_is_counted_and_its_ticket_dealt_again() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    outs = learner.says(A, spoiled(learner.rollout_of(0)))
    assert permits(outs) == [example(Permit, ticket=1, sequence=1)]
    ledger = learner.coordinator.rollouts.ledger
    assert (ledger.lost, ledger.transitions_invalid, ledger.outstanding) == (1, 1, 1)


def test_a_bad_rollout_is_let_go_by_its_worker() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    (collect,) = of(learner.says(A, spoiled(learner.rollout_of(0))), Collect)
    assert collect.received == (Received(0, 0, 1, ()),)


@pytest.mark.parametrize("kind", ["message", "rollout"])
def test_a_worker_that_keeps_sending_rubbish_is_refused_and_what_it_held_is_dealt_again(kind: str) -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    outs: list[Outgoing] = []
    for strike in range(STRIKES):
        assert A in learner.coordinator.members, strike
        if kind == "rollout":
            rollout = learner.rollout_of(learner.tickets()[0])
            outs = learner.says(A, spoiled(rollout))
        else:
            outs = learner.balanced(learner.coordinator.reject_message(A, "not understood", 0.0))
    why = "not understood" if kind == "message" else f"rollout of ticket {STRIKES - 1}: {NOT_FINITE}"
    assert outs == [(A, Refuse(why))]
    assert A not in learner.coordinator.members
    assert learner.coordinator.rollouts.ledger.outstanding == 0
    assert learner.coordinator.rollouts.ledger.messages_bad == (STRIKES if kind == "message" else 0)
    ends = [event for event in learner.coordinator.events[1:] if not isinstance(event, RolloutRejected)]
    assert ends == [WorkerRefused("a", why, 1)]  # the one line about its end


def test_what_becomes_of_each_rollout_is_an_event() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.coordinator.events.clear()
    rollout = learner.rollout_of(0)
    for each in (rollout, rollout):  # it is told once that it has come
        learner.says(A, each)
    learner.take()
    learner.publish(1)
    learner.says(A, spoiled(learner.rollout_of(1)))
    learner.says(A, learner.rollout_of(2, sequence=0))
    assert learner.coordinator.events == [
        RolloutArrived("a", 0, 0),
        RolloutRejected(A, f"rollout of ticket 1: {NOT_FINITE}"),
        RolloutRejected(
            A, "rollout of ticket 2: numbers: expected lane 0, version 1, sequence 2, got lane 0, version 1, sequence 0"
        ),
    ]


@pytest.mark.parametrize("how", ["rubbish", "revoked", "silent"])
def test_what_a_lost_worker_held_is_dealt_again_at_once(how: str) -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.now = TIMEOUT_S + 1
    learner.joins(B)
    match how:
        case "rubbish":
            outs = [out for _ in range(STRIKES) for out in learner.coordinator.reject_message(A, "rubbish", learner.now)]
        case "revoked":
            outs = learner.coordinator.revoke(A, "its key was revoked")
        case _:
            outs = learner.coordinator.remove_silent(learner.now)
    assert list(learner.coordinator.members) == [B]
    assert {permit.lane for permit in permits(outs, B)} == {0, 1}


def test_one_that_was_refused_stays_refused_and_another_process_of_its_name_may_join() -> None:
    learner = Learner(lanes=1)
    learner.joins(A, pid=1)
    for _ in range(STRIKES):
        learner.coordinator.reject_message(A, "rubbish", 0.0)
    assert learner.joins(A, pid=1, attempt=2) == [(A, Refuse("rubbish"))]
    assert kinds(learner.joins(A, pid=2), A) == [Welcome, Collect, Weights]


def test_rubbish_of_a_stranger_is_counted_and_refused() -> None:
    learner = Learner()
    ((peer, refuse),) = learner.coordinator.reject_message(b"stranger", "no head", 0.0)
    assert isinstance(refuse, Refuse)
    assert (peer, learner.coordinator.rollouts.ledger.messages_bad, learner.coordinator.members) == (b"stranger", 1, {})


def test_whatever_dtype_a_bad_rollouts_flags_have_they_are_counted_without_raising() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    bad = msgspec.structs.replace(learner.rollout_of(0), valid=np.full((1, 1), 9.0, np.float32))
    learner.says(A, bad)
    assert learner.coordinator.rollouts.ledger.transitions_invalid == 0


def test_a_late_bad_rollout_of_an_ended_session_does_not_touch_the_ticket_of_the_same_number() -> None:
    """A learner that resumed counts tickets on from its checkpoint, so numbers come again."""
    learner = Learner(lanes=1)
    learner.joins(A)
    late = fake_rollout(session=5, lane=0, ticket=0, version=0, sequence=3)
    learner.says(A, spoiled(late))
    assert learner.tickets(A) == [0]
    assert learner.coordinator.rollouts.lanes[0].out_of_order == set()


@pytest.mark.parametrize("sequence", [-1, 1, 1 << 62])
def test_a_rollout_whose_sequence_cannot_be_is_not_used(sequence: int) -> None:
    """Else `ahead` grows by one for every rollout, and goes out with every reply."""
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.says(A, learner.rollout_of(0, sequence=sequence))
    assert learner.coordinator.rollouts.lanes[0].out_of_order == set()
    assert learner.coordinator.rollouts.ledger.transitions_invalid == 1


# -------------------------------------------------------------------- leaving


def test_goodbye_forgets_the_worker_and_deals_what_it_held() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.joins(B)
    outs = learner.says(A, Goodbye(learner.session(A), "told to stop", (0, 1)))
    assert A not in learner.coordinator.members
    assert {permit.lane for permit in permits(outs, B)} == {0, 1}
    assert learner.coordinator.events[-1] == WorkerLeft("a", "left: told to stop", 2, True)


def test_of_a_heartbeat_no_tickets_are_kept() -> None:
    """They may be many, and there is one heartbeat for each worker."""
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.beats(A, tickets=range(1000))
    heartbeat = learner.coordinator.members[A].heartbeat
    assert heartbeat is not None
    assert heartbeat.tickets == ()


def test_a_traceback_is_safe_to_show() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.says(
        A, example(Failure, session=learner.session(A), error="ValueError: x", traceback="Traceback: \x1b[2J", lane=0)
    )
    raised = [event.traceback for event in learner.coordinator.events if isinstance(event, EnvironmentRaised)]
    assert raised == ["Traceback: \\x1b[2J"]


def test_failure_forgets_the_worker_and_its_traceback_is_kept_for_the_log() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.joins(B)
    outs = learner.says(
        A, example(Failure, session=learner.session(A), error="ValueError: x", traceback="Traceback: …", lane=0)
    )
    assert A not in learner.coordinator.members
    assert [permit.incarnation for permit in permits(outs, B)] == [1]
    assert EnvironmentRaised("a", "host", "ValueError: x", "Traceback: …", lanes=(0,)) in learner.coordinator.events
    assert learner.coordinator.events[-1] == WorkerLeft("a", "failed", 1, False)


@pytest.mark.parametrize(("lane", "lanes"), [(1, (1,)), (None, (0, 1)), (7, (0, 1))])
def test_a_failure_belongs_to_its_lane_or_to_all_of_the_workers_lanes(lane: int | None, lanes: tuple[int, ...]) -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.delivers(learner.tickets(A)[0])
    learner.says(A, example(Failure, session=learner.session(A), error="ValueError: x", lane=lane))
    (failed,) = [event for event in learner.coordinator.events if isinstance(event, EnvironmentRaised)]
    assert failed.lanes == lanes
    assert failed.worked_s is not None, "a rollout has env steps"


@pytest.mark.parametrize("kind", [PolicyRaised, EnvironmentRaised])
def test_a_failure_of_the_users_policy_is_told_as_one(kind: type) -> None:
    learner = Learner(lanes=1, policy=msgspec.structs.replace(run_spec().policy, own=OwnPolicySpec("mine:make", ())))
    learner.joins(A)
    learner.says(A, example(Failure, session=learner.session(A), error="KeyError", of_policy=kind is PolicyRaised))
    (failed,) = [event for event in learner.coordinator.events if isinstance(event, Failed)]
    assert type(failed) is kind


@pytest.mark.parametrize("kind", [Described, Stepped, Returned])
def test_answers_to_orders_that_a_run_does_not_give_are_ignored(kind: type) -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    for _ in range(STRIKES):
        assert learner.says(A, next(message for message in EVERY_MESSAGE if type(message) is kind)) == []
    assert (learner.coordinator.members[A].strikes, learner.tickets(A)) == (0, [0])


def test_silent_workers_are_removed_in_tick_only() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.now = 1000.0
    assert of(learner.publish(1), Rejoin) == []
    learner.joins(B)
    learner.beats(A)  # it was only slow to be heard
    learner.coordinator.remove_silent(1000.0)
    assert A in learner.coordinator.members


def test_a_silent_worker_is_forgotten_by_tick() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    assert learner.coordinator.remove_silent(TIMEOUT_S) == []
    assert A in learner.coordinator.members
    learner.balanced(learner.coordinator.remove_silent(TIMEOUT_S + 0.1))
    assert learner.coordinator.members == {}
    assert learner.coordinator.events[-1] == WorkerLeft("a", "silent for 5 s", 1, False)


@pytest.mark.parametrize("kind", ["hello", "heartbeat", "rollout", "bad rollout", "rubbish"])
def test_any_message_of_the_session_is_a_sign_of_life(kind: str) -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.now = 4.0
    match kind:
        case "hello":
            learner.joins(A)
        case "heartbeat":
            learner.beats(A)
        case "rollout":
            learner.delivers(0)
        case "bad rollout":
            learner.says(A, spoiled(learner.rollout_of(0)))
        case _:
            learner.coordinator.reject_message(A, "rubbish", learner.now)
    learner.coordinator.remove_silent(4.0 + TIMEOUT_S)
    assert A in learner.coordinator.members


def test_drain_asks_everybody_to_leave_and_deals_no_more() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.joins(B)
    assert learner.balanced(learner.coordinator.drain("finished")) == [(A, Drain("finished")), (B, Drain("finished"))]
    assert learner.coordinator.drain("finished") == [], "each was asked already"
    learner.deliver_all()
    issued = learner.coordinator.rollouts.ledger.issued
    learner.take()
    assert learner.publish(1) == []
    assert learner.coordinator.rollouts.ledger.issued == issued


def test_what_a_draining_worker_still_delivers_is_counted_and_can_be_used() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.coordinator.drain("finished")
    assert learner.delivers(0) == []
    assert len(learner.take()) == 1
    assert learner.says(A, Goodbye(100, "finished", ())) == []
    assert learner.coordinator.members == {}


def test_a_lost_drain_is_said_again_at_each_heartbeat() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.coordinator.drain("finished")
    assert learner.beats(A) == [(A, Drain("finished"))]


def test_whoever_says_hello_to_a_draining_learner_is_told_to_leave() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.coordinator.drain("finished")
    assert learner.joins(B) == [(B, Drain("finished"))]
    assert learner.joins(A, attempt=2) == [(A, Drain("finished"))]


# -------------------------------------------------------------------- the ledger and the checkpoint


def test_every_ticket_ends_as_used_or_lost() -> None:
    """`Learner.balanced` has checked both identities after every event."""
    learner = Learner(lanes=2, max_lag=1)
    learner.joins(A)
    learner.update_round(1)
    process_ends(learner.coordinator, "a", "killed")
    learner.joins(B)
    learner.update_round(2)
    counts = learner.coordinator.rollouts.ledger.counts()
    assert {name: counts[name] for name in ("issued", "used", "lost", "outstanding")} == {
        "issued": 12, "used": 4, "lost": 4, "outstanding": 4,
    }  # fmt: skip


def test_every_transition_that_arrived_is_used_or_counted_under_a_reason() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    rollout = learner.rollout_of(0)
    learner.says(A, rollout)
    learner.says(A, rollout)  # duplicate
    learner.take()
    learner.publish(1)
    learner.says(A, spoiled(learner.rollout_of(1)))  # invalid
    learner.says(A, msgspec.structs.replace(rollout, session=5))  # late
    counts = learner.coordinator.rollouts.ledger.counts()
    named = ("used", "duplicate", "invalid", "late")
    assert [counts[f"transitions_{name}"] for name in named] == [1, 1, 1, 1]
    assert counts["transitions_received"] == 4
    assert counts["transitions_waiting"] == 0


@pytest.mark.parametrize("max_lag", [0, 1])
def test_after_an_update_was_undone_all_is_as_before_its_rollouts_were_taken(max_lag: int) -> None:
    """An episode of each lane runs all the time. With lag, a rollout of the next round comes during the update."""
    learner = Learner(lanes=2, max_lag=max_lag)
    rollouts = learner.coordinator.rollouts
    rollouts.histories = LaneHistories(copies=1, most_steps=100)

    def deliver(number: int, lanes: int = 2) -> None:
        permits = [ticket.permit for ticket in rollouts.held.values()]
        for held in [each.ticket for each in permits if each.round == number and each.lane < lanes]:
            begun = (EpisodeBegin(0, 0, b""),) if number == 0 else ()
            rollout = msgspec.structs.replace(learner.rollout_of(held), begun=begun, memory=fake_memory(number))
            learner.says(A, rollout)

    learner.joins(A)
    for number in range(2):
        deliver(number)
        learner.take()
        learner.publish(number + 1)
    deliver(2)
    before = saved(learner)
    taken = rollouts.take() or []
    deliver(3, lanes=1)
    assert saved(learner) != before
    rollouts.not_used(taken)
    learner.balanced([])
    assert saved(learner) == before
    assert [len(past.action) for past in rollouts.pasts()] == [2, 2]
    assert rollouts.ledger.lost == 0
    process_ends(learner.coordinator, "a", "killed")
    learner.joins(B)
    begun = [ticket.permit for ticket in rollouts.held.values()]
    dealt = [(permit.lane, permit.round, len(permit.past.action)) for permit in begun if permit.past]
    assert dealt == [(1, 3, 3)] * max_lag, "the rollout that was put back is part of the past"
    assert [arrived.fresh for arrived in rollouts.take() or []] == [[False]] * 2


def test_a_worker_that_continues_no_lane_is_sent_no_past_and_its_first_rollout_is_fresh() -> None:
    """The past stays, for the next worker that continues lanes."""
    learner = Learner(lanes=1)
    rollouts = learner.coordinator.rollouts
    rollouts.histories = LaneHistories(copies=1, most_steps=100)

    def deliver(begun: EpisodeBegin) -> list[AcceptedRollout] | None:
        (number,) = learner.tickets()
        rollout = msgspec.structs.replace(learner.rollout_of(number), begun=(begun,), memory=fake_memory(1))
        learner.says(rollouts.held[number].peer, rollout)
        return rollouts.take()

    learner.joins(A)
    deliver(EpisodeBegin(0, 0, b""))
    learner.publish(1)
    process_ends(learner.coordinator, "a", "killed")
    (permit,) = permits(learner.says(B, example(Hello, worker="b", continues=False)))
    assert (permit.incarnation, permit.past) == (1, None)
    (accepted,) = deliver(EpisodeBegin(0, 0, b"")) or []
    assert np.all(accepted.fresh)
    learner.publish(2)
    process_ends(learner.coordinator, "b", "killed")
    (permit,) = permits(learner.joins(A))
    assert permit.past is not None


def saved(learner: Learner) -> object:
    """What a checkpoint has of rounds and lanes."""
    past = learner.coordinator.past(learner.coordinator.version)
    return packed(msgspec.structs.replace(past, ledger=Ledger(), incarnations=[])).tobytes()


def test_weights_that_still_act_keep_their_attributes_when_they_are_published_again_to_be_evaluated() -> None:
    """A run is resumed whose weights 2 act in round 3, and were being evaluated alongside training."""
    learner = Learner(lanes=2, publish=False, rounds=Rounds(1, 3, {3: 2}))
    coordinator = learner.coordinator
    coordinator.keep(Weights(2, PARAMETERS, BUFFERS, np.array([7, 0], np.uint8)))
    coordinator.publish(2, PARAMETERS, BUFFERS)
    coordinator.publish(3, PARAMETERS, BUFFERS, env_attributes=np.array([8, 0], np.uint8))
    coordinator.begin_update()
    sent = {each.version: each.env_attributes for _, each in learner.joins(A) if isinstance(each, Weights)}
    assert [(version, None if each is None else each.tolist()) for version, each in sent.items()] == [
        (2, [7, 0]),
        (3, [8, 0]),
    ]
    coordinator.rollouts.histories = LaneHistories(copies=1, most_steps=100)
    for ticket, begun in zip([0, 2, 1, 3], [(EpisodeBegin(0, 0, b""),)] * 2 + [()] * 2, strict=True):
        learner.says(A, msgspec.structs.replace(learner.rollout_of(ticket), begun=begun, memory=fake_memory(1)))
    for _ in range(2):
        learner.take()
    assert [past.attributes.by_row() for past in coordinator.rollouts.pasts()] == [{0: bytes([7, 0]), 1: bytes([8, 0])}] * 2
    one, other = ([rows.attributes for rows in lane.history.rows] for lane in coordinator.rollouts.lanes if lane.history)
    assert list(map(id, one)) == list(map(id, other)), "they may be long, and are stored once for all lanes"


def test_a_checkpoint_has_all_weights_of_open_rounds_but_those_that_the_next_learner_publishes_first() -> None:
    """Also while others are the newest, because they are evaluated."""
    learner = Learner(publish=False, rounds=Rounds(1, 3, {3: 2}))
    coordinator = learner.coordinator
    coordinator.keep(Weights(2, PARAMETERS, BUFFERS, np.array([7, 0], np.uint8)))
    for published in (None, 2, 3, 4):
        if published is not None:
            coordinator.publish(published, PARAMETERS, BUFFERS)
        if published == 3:
            coordinator.begin_update()
            assert [weights.version for weights in coordinator.past(4).acting] == [2, 3]
        (weights,) = coordinator.past(3).acting
        assert (weights.version, weights.env_attributes is not None) == (2, True)


def test_incarnations_for_a_checkpoint_name_no_life_that_was_dealt_a_ticket() -> None:
    learner = Learner(lanes=2, publish=False)
    learner.joins(A)
    assert learner.coordinator.rollouts.incarnations() == [0, 0]
    learner.publish(0)
    assert learner.coordinator.rollouts.incarnations() == [1, 1]
    process_ends(learner.coordinator, "a", "killed")
    assert learner.coordinator.rollouts.incarnations() == [1, 1]


def test_no_life_is_lived_twice_across_resumes() -> None:
    """Every (lane, incarnation) that is dealt tickets is dealt them in one session of one learner."""
    lives: set[tuple[int, int]] = set()
    ledger, incarnations, version = Ledger(), [0, 0, 0], 0
    for pid in range(4):
        learner = Learner(lanes=3, ledger=ledger, incarnations=incarnations, publish=False)
        learner.publish(version)
        for peer in (A, B, C):
            fresh = {(permit.lane, permit.incarnation) for permit in permits(learner.joins(peer, pid=pid))}
            assert len(fresh) == 3
            assert not fresh & lives
            lives |= fresh
            learner.update()
            process_ends(learner.coordinator, peer.decode(), "killed")
        version, ledger = learner.coordinator.version, msgspec.structs.replace(learner.coordinator.rollouts.ledger)
        incarnations = learner.coordinator.rollouts.incarnations()
        ledger.lost += ledger.outstanding


def test_a_resumed_learner_counts_tickets_on() -> None:
    ledger = Ledger(issued=10, used=8, lost=2)
    learner = Learner(lanes=2, ledger=ledger, publish=False)
    learner.publish(4)
    outs = learner.joins(A)
    assert [permit.ticket for permit in permits(outs)] == [10, 11]


@pytest.mark.parametrize("max_lag", [0, 1, 3])
@pytest.mark.parametrize(("before", "lanes"), [(2, 3), (3, 2), (4, 1), (1, 4)])
def test_a_resumed_run_with_other_lanes_deals_tickets_from_there(before: int, lanes: int, max_lag: int) -> None:
    """100 updates were made of `before` rollouts each. Now each takes one rollout of each of the present lanes."""
    ledger = Ledger(issued=100 * before, used=100 * before)
    learner = Learner(lanes=lanes, max_lag=max_lag, ledger=ledger, publish=False)
    learner.publish(100)
    learner.joins(A)
    for update in range(1, 6):
        assert len(learner.tickets()) == lanes * (1 + max_lag), f"update {update}"
        learner.deliver_round()
        assert sorted(rollout.lane for rollout in learner.take()) == list(range(lanes))
        learner.publish(100 + update)
    assert learner.coordinator.rollouts.ledger.used == 100 * before + 5 * lanes


def test_a_lane_that_is_given_up_and_comes_back_does_not_live_again() -> None:
    two = Learner(lanes=2, incarnations=[3, 4, 5, 6])
    two.joins(A)
    assert two.coordinator.rollouts.incarnations() == [4, 5, 5, 6]
    assert Learner(lanes=3, incarnations=[4, 5, 5, 6]).coordinator.rollouts.incarnations() == [4, 5, 5, 6]
    assert Learner(lanes=3, incarnations=[7]).coordinator.rollouts.incarnations() == [7, 0, 0]


def test_a_rollout_is_fresh_unless_it_continues_the_one_that_was_used_before() -> None:
    learner = Learner(lanes=1, max_lag=3)
    learner.joins(A)
    first, second, third, _ = learner.tickets()
    learner.delivers(first)
    learner.delivers(second)
    # The third round is collected again, after the fourth.
    learner.says(A, spoiled(learner.rollout_of(third)))
    learner.deliver_all()
    used = [arrived for _ in range(4) for arrived in learner.coordinator.rollouts.take() or []]
    assert [(arrived.rollout.sequence, arrived.fresh) for arrived in used] == [(0, True), (1, False), (4, True), (3, True)]


def test_a_rollout_continues_only_one_of_its_own_incarnation() -> None:
    """The first of the new incarnation was rejected."""
    lane = TicketedLane(0)
    used = [
        lane.take(incarnation, fake_rollout(1, 0, 0, 0, sequence), b"", LaneHistories(), from_past=False)
        for incarnation, sequence in ((0, 0), (0, 1), (1, 2), (1, 3))
    ]
    assert [bool(fresh) for fresh in used] == [True, False, True, False]


# -------------------------------------------------------------------- how a worker stands with the learner

Standing = Literal["unknown", "active", "draining"]


def standing_of(learner: Learner, peer: bytes) -> Standing:
    member = learner.coordinator.members.get(peer)
    return "unknown" if member is None else "draining" if member.draining else "active"


def in_standing(standing: Standing) -> Learner:
    learner = Learner(lanes=1)
    if standing != "unknown":
        learner.joins(A)
    if standing == "draining":
        learner.coordinator.drain("finished")
    assert standing_of(learner, A) == standing
    return learner


EVERY_MESSAGE = to_learner(100, "a", 1001)
CHANGES: dict[Standing, dict[type, Standing]] = {
    "unknown": {Hello: "active"},
    "active": {Goodbye: "unknown", Failure: "unknown"},
    "draining": {Goodbye: "unknown", Failure: "unknown"},
}


@pytest.mark.parametrize("standing", CHANGES)
@pytest.mark.parametrize("message", EVERY_MESSAGE, ids=lambda message: type(message).__name__)
def test_a_worker_joins_with_a_hello_and_leaves_with_a_goodbye_or_a_failure(standing: Standing, message: ToLearner) -> None:
    learner = in_standing(standing)
    learner.says(A, message)
    assert standing_of(learner, A) == CHANGES[standing].get(type(message), standing)


@pytest.mark.parametrize("standing", ["active", "draining"])
@pytest.mark.parametrize("ends", ["silent", "sent rubbish", "key revoked", "process ended"])
def test_a_membership_ends_in_every_standing(standing: Standing, ends: str) -> None:
    learner = in_standing(standing)
    match ends:
        case "silent":
            learner.coordinator.remove_silent(1e6)
        case "sent rubbish":
            for _ in range(STRIKES):
                learner.coordinator.reject_message(A, "rubbish", 0.0)
        case "key revoked":
            learner.coordinator.revoke(A, "its key was revoked")
        case "process ended":
            nonce = learner.coordinator.members[A].hello.process_nonce
            learner.coordinator.process_ended(WorkerExit("a", nonce, "was killed by SIGKILL", failed=True))
    assert standing_of(learner, A) == "unknown"


@pytest.mark.parametrize(
    ("how", "failures", "losses"),
    [("silent", [0, 0], [1, 1]), ("failed in lane 1", [0, 1], [1, 0]), ("killed", [0, 0], [1, 1]), ("hung", [1, 1], [0, 0])],
)
def test_how_a_worker_was_lost_decides_in_which_of_its_lanes_the_environment_counts_as_failed(
    how: str, failures: list[int], losses: list[int]
) -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    member = learner.coordinator.members[A]
    match how:
        case "silent":
            learner.coordinator.remove_silent(1e6)
        case "failed in lane 1":
            learner.says(A, example(Failure, session=member.session, lane=1))
        case _:
            nonce = member.hello.process_nonce
            learner.coordinator.process_ended(WorkerExit("a", nonce, "was ended", failed=True, hung=how == "hung"))
    lanes = learner.coordinator.rollouts.lanes
    assert [lane.failures for lane in lanes] == failures
    assert [lane.losses for lane in lanes] == losses


def test_why_one_was_silent_is_told_once_it_is_known() -> None:
    learner = Learner()
    learner.joins(b"a")
    learner.joins(b"b")
    learner.now += TIMEOUT_S + 1
    learner.balanced(learner.coordinator.remove_silent(learner.now))
    learner.coordinator.events.clear()
    for _ in range(2):
        learner.balanced(process_ends(learner.coordinator, "a", "was ended: too slow", nonce=4001))
    assert learner.coordinator.events == [WorkerLeft("a", "was ended: too slow", 0, False)]
    learner.joins(b"b", attempt=2)
    learner.says(b"b", Goodbye(learner.session(b"b"), "told to stop", ()))
    learner.coordinator.events.clear()
    learner.balanced(process_ends(learner.coordinator, "b", "ended with exit code 0", nonce=4001))
    assert learner.coordinator.events == []


def test_the_most_tickets_that_a_run_may_have_outstanding_fit_one_message() -> None:
    numbers = range(2**31, 2**31 + MOST_TICKETS)
    received = tuple(Received(n, 200, 10**5) for n in range(MOST_TICKETS))
    order = example(
        Collect,
        session=2**48,
        version=10**6,
        permits=tuple(
            example(Permit, ticket=number, lane=n, incarnation=200, sequence=10**5) for n, number in enumerate(numbers)
        ),
        received=received,
    )
    assert decode_to_worker([bytes(frame) for frame in encode(order)]) == order


def test_what_workers_note_of_the_environment_is_told_once() -> None:
    learner = Learner()
    notes = ["it has a mask", "it has a mask", "", *(f"note {n}" for n in range(2 * MOST_NOTES))]
    for peer in (A, B):
        learner.joins(peer)
        for note in notes:
            learner.says(
                peer,
                example(
                    Heartbeat, session=learner.session(peer), versions=(0,), tickets=tuple(learner.tickets(peer)), note=note
                ),
            )
    told = [event for event in learner.coordinator.events if isinstance(event, EnvironmentNoted)]
    assert len(told) == MOST_NOTES
    assert [describe(event) for event in told[:2]] == ["worker a: it has a mask", "worker a: note 0"]
