"""The session of a worker, one rule in each test. Pure: the test plays the learner, and time is a number."""

from __future__ import annotations

import dataclasses
import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import msgspec
import numpy as np
import pytest

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import (
    Collect,
    Describe,
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
    Reset,
    Rollout,
    Step,
    Stepped,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
)
from millrace.protocol.space_spec import DiscreteSpace, EnvDescription
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec
from millrace.protocol.wire.codec import decode_to_learner, encode
from millrace.workers.conversation.connection_rules import wait_limits_s
from millrace.workers.conversation.held import KEPT_RESULTS
from millrace.workers.conversation.session import (
    HELLO_FIRST_S,
    HELLO_MOST_S,
    NO_LEARNER,
    BeginRun,
    CloseLanes,
    EvaluationTask,
    Leave,
    RolloutTask,
    SendMessage,
    Session,
    StartSession,
    Statistics,
    WorkerEffect,
    WorkerIdentity,
)
from millrace.workers.conversation.worker_states import TABLE, WorkerState
from millrace.workers.exit_codes import EXIT_UNSUITABLE
from tests.support.conversation.every_message import to_worker
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, fake_evaluated, fake_rollouts, held_count, run_spec

M = TypeVar("M")

WHO = WorkerIdentity("w0", "host", 7, 77, "fake 1")
RUN = run_spec(lanes=4)  # heartbeat_s 1, learner_timeout_s 6
SESSION = 11
JOIN_S, REJOIN_S = 60.0, 600.0
EVALUATE = example(Evaluate, session=SESSION, ticket=8, seeds=(1, 2), greedy=True)
FIRST = WHO.process_nonce + 1  # number of the first attempt to join


def sent(effects: Sequence[WorkerEffect], kind: type[M]) -> list[M]:
    """The messages of this kind among the effects."""
    return [effect.message for effect in effects if isinstance(effect, SendMessage) and isinstance(effect.message, kind)]


def weights(version: int) -> Weights:
    return Weights(version, PARAMETERS, BUFFERS)


def lanes(*numbers: int, below: int = 0, ahead: tuple[int, ...] = (), incarnation: int = 0) -> tuple[Received, ...]:
    """The learner's account: these lanes are the worker's, and so much of each has arrived."""
    return tuple(Received(number, incarnation, below, ahead) for number in numbers)


def collect(
    *tickets: tuple[int, int],
    version: int = 0,
    incarnation: int = 0,
    first: int = 0,
    received: tuple[Received, ...] | None = None,
    keep: tuple[int, ...] = (),
) -> Collect:
    """Permission for (ticket, lane) pairs, in the order of their sequence, which begins with `first` in each lane.

    The lanes named are all that the worker has, unless `received` says more.
    """
    sequences: defaultdict[int, Iterator[int]] = defaultdict(lambda: itertools.count(first))
    permits = tuple(
        example(Permit, ticket=ticket, lane=lane, incarnation=incarnation, sequence=next(sequences[lane]))
        for ticket, lane in tickets
    )
    theirs = lanes(*sorted(sequences), incarnation=incarnation) if received is None else received
    return example(Collect, session=SESSION, version=version, permits=permits, received=theirs, keep=keep)


def joining() -> Session:
    return Session(WHO, 0.0, join_timeout_s=JOIN_S, rejoin_timeout_s=REJOIN_S)


def ready(*messages: ToWorker, version: int | None = 0) -> Session:
    """A session that was welcomed at time 0, holds weights of this version, and then heard `messages`."""
    session = joining()
    session.tick(0.0)
    session.handle(Welcome(SESSION, FIRST, RUN), 0.0)
    if version is not None:
        session.handle(weights(version), 0.0)
    for message in messages:
        session.handle(message, 0.0)
    return session


def task_of(session: Session) -> RolloutTask:
    task = session.next_work()
    assert isinstance(task, RolloutTask)
    return task


def versions_held(session: Session) -> tuple[int, ...]:
    """As the next Heartbeat lists them."""
    (heartbeat,) = sent(session.tick(session.due_s), Heartbeat)
    return heartbeat.versions


def collected(session: Session) -> list[Rollout]:
    """Collect the next task; the rollouts that were said."""
    return sent(session.work_ended(fake_rollouts(task_of(session))), Rollout)


def drained(session: Session) -> list[WorkerEffect]:
    """The learner asks the worker to leave."""
    return session.handle(Drain("finished"), 0.1)


def stepped(order: Reset) -> Stepped:
    flag, nothing = np.zeros(1, bool), np.zeros(0, np.uint8)
    return example(
        Stepped,
        session=SESSION,
        ticket=order.ticket,
        lane=order.lane,
        incarnation=order.incarnation,
        reward=np.zeros(1),
        terminated=flag,
        truncated=flag,
        infos=nothing,
    )


def hello_attempt(effects: Sequence[WorkerEffect]) -> int:
    (hello,) = sent(effects, Hello)
    return hello.attempt


# -------------------------------------------------------------------- joining


def test_hello_has_the_identity_and_the_protocol_version() -> None:
    (hello,) = sent(joining().tick(0.0), Hello)
    assert hello == example(Hello, pid=7, process_nonce=77, software="fake 1", attempt=FIRST)


def test_hello_repeats_with_backoff_and_keeps_its_attempt() -> None:
    session = joining()
    times, attempts = [], set()
    for step in range(120):
        now = step * HELLO_FIRST_S
        for hello in sent(session.tick(now), Hello):
            times.append(now)
            attempts.add(hello.attempt)
    gaps = [after - before for before, after in itertools.pairwise(times)]
    assert gaps[:5] == [0.25, 0.5, 1.0, 2.0, 4.0]
    assert set(gaps[4:]) == {HELLO_MOST_S}
    assert attempts == {FIRST}


def test_joining_again_raises_the_attempt_and_resets_the_backoff() -> None:
    session = ready()
    assert hello_attempt(session.handle(Rejoin(SESSION), 5.0)) == FIRST + 1
    assert session.due_s == 5.0 + HELLO_FIRST_S


def test_welcome_starts_a_session() -> None:
    session = joining()
    session.tick(0.0)
    assert session.handle(Welcome(SESSION, FIRST, RUN), 0.1) == [StartSession(RUN)]
    assert (session.state, session.session, session.run) == (WorkerState.READY, SESSION, RUN)


def test_welcome_for_an_older_attempt_is_ignored() -> None:
    session = ready()
    session.handle(Rejoin(SESSION), 1.0)
    assert session.handle(Welcome(12, FIRST, RUN), 1.1) == []
    assert session.state is WorkerState.JOINING
    assert session.handle(Welcome(13, FIRST + 1, RUN), 1.2) == [StartSession(RUN)]


def test_welcome_for_a_process_that_has_ended_is_ignored() -> None:
    """The learner answers its delayed Hello when another process of the same name joins."""
    ended = dataclasses.replace(WHO, process_nonce=WHO.process_nonce - 1_000)
    (late,) = sent(Session(ended, 0.0, join_timeout_s=JOIN_S, rejoin_timeout_s=REJOIN_S).tick(0.0), Hello)
    session = joining()
    session.tick(0.0)
    assert session.handle(Welcome(12, late.attempt, RUN), 0.1) == []
    assert session.state is WorkerState.JOINING


def test_a_repeated_welcome_is_ignored() -> None:
    session = ready(collect((0, 0)))
    assert session.handle(Welcome(SESSION, FIRST, RUN), 0.1) == []
    assert held_count(session) == 1


def test_welcome_to_another_session_of_the_same_attempt_starts_anew() -> None:
    """The learner gave this worker up, then heard a late Hello of it."""
    session = ready(collect((0, 0)))
    assert session.handle(Welcome(12, FIRST, RUN), 0.1) == [StartSession(RUN)]
    assert (session.session, held_count(session)) == (12, 0)


def test_every_other_message_while_joining_is_ignored() -> None:
    session = joining()
    session.tick(0.0)
    for message in (weights(0), collect((0, 0)), HeartbeatReply(0, 1, ()), Release(0, (LaneIncarnation(0, 0),)), Rejoin(0)):
        assert session.handle(message, 0.1) == []
    assert (session.state, held_count(session)) == (WorkerState.JOINING, 0)


def test_a_worker_gives_up_joining_with_exit_code_1() -> None:
    session = joining()
    assert sent(session.tick(JOIN_S), Hello)
    (leave,) = session.tick(JOIN_S + 0.1)
    assert isinstance(leave, Leave)
    assert leave.exit_code == 1
    assert "no learner answered for 60 s" in leave.reason


def test_a_worker_that_had_joined_waits_longer_for_the_learner() -> None:
    session = ready()
    session.handle(Rejoin(SESSION), 1.0)
    assert sent(session.tick(1.0 + REJOIN_S), Hello)
    (leave,) = session.tick(1.0 + REJOIN_S + 0.1)
    assert isinstance(leave, Leave)


def test_a_worker_waits_as_long_for_a_learner_that_it_had_joined_or_longer() -> None:
    assert wait_limits_s(60.0, stay=False) == (60.0, REJOIN_S)
    assert wait_limits_s(3600.0, stay=False) == (3600.0, 3600.0)


def test_a_worker_that_stays_waits_without_a_limit_until_it_has_joined() -> None:
    join_timeout_s, rejoin_timeout_s = wait_limits_s(60.0, stay=True)
    session = Session(WHO, 0.0, join_timeout_s=join_timeout_s, rejoin_timeout_s=rejoin_timeout_s)
    assert sent(session.tick(1e9), Hello)
    session.handle(Welcome(SESSION, FIRST, RUN), 1e9)
    session.handle(Rejoin(SESSION), 1e9)
    (leave,) = session.tick(1e9 + REJOIN_S + 0.1)
    assert isinstance(leave, Leave)
    assert leave.reason.startswith(NO_LEARNER)


# -------------------------------------------------------------------- tickets


def test_a_repeated_collect_is_collected_once() -> None:
    session = ready(collect((0, 0)), collect((0, 0)))
    assert held_count(session) == 1
    assert len(collected(session)) == 1
    assert session.next_work() is None


def test_a_repeat_of_the_ticket_in_progress_is_collected_once() -> None:
    session = ready(collect((0, 0)))
    task = task_of(session)
    session.handle(collect((0, 0)), 0.1)
    assert len(sent(session.work_ended(fake_rollouts(task)), Rollout)) == 1
    assert session.next_work() is None


def test_a_repeat_of_a_finished_ticket_sends_the_same_rollout_object_again() -> None:
    session = ready(collect((0, 0)))
    (rollout,) = collected(session)
    (again,) = sent(session.handle(collect((0, 0)), 1.0), Rollout)
    assert again is rollout
    assert session.next_work() is None


def test_a_rollout_is_kept_until_the_learner_has_received_it() -> None:
    session = ready(collect((0, 0)))
    collected(session)
    session.handle(HeartbeatReply(SESSION, 1, lanes(0, below=0)), 1.0)
    assert held_count(session) == 1
    session.handle(HeartbeatReply(SESSION, 2, lanes(0, below=1)), 2.0)
    assert held_count(session) == 0


def test_a_rollout_that_arrived_ahead_of_a_lost_one_is_forgotten_and_the_lost_one_kept() -> None:
    session = ready(collect((0, 0), (1, 0)))
    first, second = collected(session) + collected(session)
    assert (first.sequence, second.sequence) == (0, 1)
    session.handle(HeartbeatReply(SESSION, 1, lanes(0, below=0, ahead=(1,))), 1.0)
    assert held_count(session) == 1
    assert sent(session.handle(collect((0, 0)), 1.0), Rollout) == [first]


def test_collect_also_lists_what_was_received() -> None:
    session = ready(collect((0, 0)))
    collected(session)
    session.handle(collect((1, 0), first=1, received=lanes(0, below=1)), 0.1)
    assert held_count(session) == 1  # the new ticket


def test_received_of_another_incarnation_of_the_lane_drops_nothing() -> None:
    session = ready(collect((0, 0), incarnation=1))
    collected(session)
    session.handle(HeartbeatReply(SESSION, 1, lanes(0, below=9, incarnation=0)), 1.0)
    assert held_count(session) == 1


def test_a_late_repeat_of_a_ticket_whose_rollout_was_received_is_ignored() -> None:
    session = ready(collect((0, 0)))
    collected(session)
    session.handle(HeartbeatReply(SESSION, 1, lanes(0, below=1)), 1.0)
    assert session.handle(collect((0, 0), received=lanes(0, below=1)), 1.1) == []
    assert session.next_work() is None
    assert held_count(session) == 0


def test_the_next_rollout_of_every_lane_is_collected_together_in_lane_order() -> None:
    session = ready(collect((5, 2), (3, 2), (9, 0), (4, 1)))
    assert [(each.lane, each.ticket) for each in task_of(session).permits] == [(0, 9), (1, 4), (2, 5)]


def test_a_permit_is_not_started_before_an_earlier_one_that_has_not_come() -> None:
    """Else the rollouts of a lane, and the weights that act in them, would depend on what the network loses."""
    session = ready(collect((1, 0), first=1))
    assert session.next_work() is None
    session.handle(collect((0, 0)), 0.1)
    assert [(rollout.ticket, rollout.sequence) for _ in range(2) for rollout in collected(session)] == [(0, 0), (1, 1)]


def test_one_task_at_a_time() -> None:
    session = ready(collect((0, 0), (1, 0), (2, 1)))
    task = task_of(session)
    assert session.next_work() is None
    session.work_ended(fake_rollouts(task))
    assert task_of(session).permits[0].ticket == 1


def test_an_evaluation_comes_before_rollouts() -> None:
    session = ready(collect((0, 0)), EVALUATE)
    task = session.next_work()
    assert isinstance(task, EvaluationTask)
    assert session.next_work() is None
    answer = fake_evaluated(task)
    assert session.work_ended([answer]) == [SendMessage(answer)]
    assert task_of(session).permits[0].ticket == 0


def test_an_evaluation_is_played_under_its_version_although_newer_weights_are_held() -> None:
    session = ready(weights(1), EVALUATE, weights(0))
    task = session.next_work()
    assert isinstance(task, EvaluationTask)
    assert task.weights.version == EVALUATE.version == 0


@pytest.mark.parametrize("late", [False, True])
def test_the_order_of_a_later_evaluation_ends_those_before_it(late: bool) -> None:
    """Also if the earlier one comes late. The version does not say which is later: the tickets do."""
    earlier = msgspec.structs.replace(EVALUATE, version=4)
    later = msgspec.structs.replace(EVALUATE, version=3, ticket=EVALUATE.ticket + 2)
    session = ready(*([later, earlier] if late else [earlier, later]))
    assert sent(session.tick(1.0), Heartbeat)[0].tickets == (later.ticket,)


def test_an_evaluation_waits_for_its_weights_and_the_oldest_comes_first() -> None:
    session = ready(*(msgspec.structs.replace(EVALUATE, version=1, ticket=ticket) for ticket in (9, 8)))
    assert session.next_work() is None
    session.handle(weights(1), 0.1)
    task = session.next_work()
    assert isinstance(task, EvaluationTask)
    assert task.order.ticket == 8


def test_a_repeated_evaluation_is_answered_again() -> None:
    session = ready(EVALUATE)
    task = session.next_work()
    assert isinstance(task, EvaluationTask)
    answer = fake_evaluated(task)
    session.work_ended([answer])
    assert session.handle(EVALUATE, 0.1) == [SendMessage(answer)]
    assert session.next_work() is None


@pytest.mark.parametrize("field", ["send_rows", "send_frames"])
def test_a_repeated_evaluation_whose_rows_were_sent_is_played_again(field: str) -> None:
    """Rows are large: they are not kept."""
    order = msgspec.structs.replace(EVALUATE, **{field: True})
    session = ready(order)
    for _ in range(2):
        task = session.next_work()
        assert isinstance(task, EvaluationTask)
        session.work_ended([fake_evaluated(task)])
        assert session.handle(order, 0.1) == []


def test_the_number_of_kept_results_of_evaluations_is_bounded() -> None:
    session = ready()
    for ticket in range(KEPT_RESULTS + 1):
        session.handle(msgspec.structs.replace(EVALUATE, ticket=ticket), 0.1)
        task = session.next_work()
        assert isinstance(task, EvaluationTask)
        session.work_ended([fake_evaluated(task)])
    assert list(session._current.evaluations.answered) == list(range(1, KEPT_RESULTS + 1))


def test_the_oldest_order_of_all_lanes_is_executed_first() -> None:
    session = joining()
    session.handle(Welcome(SESSION, FIRST, StepSpec((EnvSpec("Any-v0"),), (0, 1), (1, 1), (), ())), 0.0)
    later, earlier = (
        example(Reset, session=SESSION, ticket=ticket, lane=lane, copies=(0,), seeds=(None,), options=np.zeros(0, np.uint8))
        for lane, ticket in ((0, 7), (1, 6))
    )
    session.handle(later, 0.1)
    session.handle(earlier, 0.1)
    assert session.next_work() == earlier
    assert sent(session.tick(session.due_s), Heartbeat)[0].tickets == (7, 6)


def test_only_the_newest_order_of_a_lane_counts() -> None:
    session = joining()
    session.handle(Welcome(SESSION, FIRST, StepSpec((EnvSpec("Any-v0"),), (0,), (1,), (), ())), 0.0)
    earlier, later = (
        example(Reset, session=SESSION, ticket=ticket, copies=(0,), seeds=(None,), options=np.zeros(0, np.uint8))
        for ticket in (6, 7)
    )
    for order in (earlier, later, earlier):
        assert session.handle(order, 0.1) == []
    assert session.next_work() == later
    answer = stepped(later)
    session.work_ended([answer])
    assert session.next_work() is None
    (again,) = session.handle(later, 0.2)
    assert isinstance(again, SendMessage)
    assert again.message is answer
    assert session.handle(earlier, 0.2) == []
    assert session.next_work() is None


@pytest.mark.parametrize(
    ("run", "order"),
    [
        (RUN, example(Step, session=SESSION, ticket=3)),
        (StepSpec((EnvSpec("Any-v0"),), (0,), (1,), (), ()), collect((0, 0))),
        (StepSpec((EnvSpec("Any-v0"),), (0,), (1,), (), ()), EVALUATE),
    ],
)
def test_an_order_of_another_kind_of_session_is_not_taken(run: RunSpec | StepSpec, order: ToWorker) -> None:
    session = joining()
    session.tick(0.0)
    session.handle(Welcome(SESSION, FIRST, run), 0.0)
    session.handle(weights(0), 0.0)
    session.handle(order, 0.1)
    assert session.next_work() is None


def test_finished_with_nothing_puts_the_tickets_back() -> None:
    session = ready(collect((0, 0)))
    task_of(session)
    assert session.work_ended([]) == []
    assert task_of(session).permits[0].ticket == 0


def test_the_worker_holds_at_most_what_the_learner_has_outstanding() -> None:
    """Five tickets outstanding at any time, in a hundred rounds: received rollouts are dropped when new tickets come."""
    session = ready()
    issued = arrived = 0
    for _ in range(100):
        fresh = [(issued + n, 0) for n in range(5)]
        session.handle(collect(*fresh, first=issued, received=lanes(0, below=arrived)), 0.1)
        issued += 5
        assert held_count(session) <= 5
        while session.next_work() is not None:
            session.work_ended([])
            arrived += len(collected(session))
            assert held_count(session) <= 5
    assert arrived == issued == 500


# -------------------------------------------------------------------- weights


def test_without_weights_nothing_starts() -> None:
    session = ready(collect((0, 0), version=0), version=None)
    assert session.next_work() is None


def test_a_rollout_starts_only_under_exactly_the_weights_that_its_order_names() -> None:
    session = ready(collect((0, 0), version=2), weights(3), version=1)
    assert session.next_work() is None
    session.handle(weights(2), 0.2)
    assert task_of(session).weights.version == 2


def test_a_permit_does_not_overtake_one_whose_weights_have_not_come() -> None:
    session = ready(collect((0, 0), version=1), collect((1, 0), version=2, first=1), weights(2))
    assert session.next_work() is None
    session.handle(weights(1), 0.1)
    assert [(rollout.ticket, rollout.version) for _ in range(2) for rollout in collected(session)] == [(0, 1), (1, 2)]


def test_lanes_of_the_lowest_version_go_first_and_different_versions_are_not_collected_together() -> None:
    orders = collect((0, 0), version=1), collect((1, 1), (2, 2), version=0)
    session = ready(*orders, weights(0), weights(1), version=None)
    collections = [[(rollout.ticket, rollout.version) for rollout in collected(session)] for _ in range(2)]
    assert collections == [[(1, 0), (2, 0)], [(0, 1)]]


def test_a_lane_whose_weights_have_come_does_not_wait_for_one_of_a_lower_version() -> None:
    session = ready(collect((0, 0), version=1), collect((1, 1), version=2), weights(2))
    assert [(rollout.ticket, rollout.version) for rollout in collected(session)] == [(1, 2)]


def test_an_order_lists_the_weights_that_are_kept_besides_those_that_tickets_name() -> None:
    session = ready(collect((0, 0)), weights(1), weights(2))
    collected(session)
    assert versions_held(session) == (0, 1, 2), "an order that is on its way may name them"
    session.handle(collect((1, 0), version=2, first=1, keep=(1, 2)), 0.2)
    session.handle(weights(3), 0.2)
    assert versions_held(session) == (1, 2, 3)
    session.handle(collect((0, 0), keep=(0,)), 0.3)
    assert versions_held(session) == (2,), "a late copy drops nothing that is asked for"


def test_an_order_to_evaluate_lists_them_too() -> None:
    session = ready(weights(1), weights(2), msgspec.structs.replace(EVALUATE, keep=(0, 2)))
    assert versions_held(session) == (0, 2)


def test_weights_of_work_that_was_abandoned_are_kept() -> None:
    session = ready(collect((0, 0), version=0), weights(1))
    task_of(session)
    session.work_ended([])
    assert task_of(session).weights.version == 0


@pytest.mark.parametrize(
    "message", [Release(SESSION, (LaneIncarnation(0, 0),)), HeartbeatReply(SESSION, 1, ())], ids=lambda m: type(m).__name__
)
def test_a_lane_that_closes_drops_no_weights(message: ToWorker) -> None:
    """The learner takes them to be held until its next order says otherwise."""
    session = ready(collect((0, 0)), weights(1))
    session.handle(message, 0.1)
    assert versions_held(session) == (0, 1)


def test_weights_that_come_twice_are_ignored() -> None:
    first = weights(0)
    session = ready(first, weights(0), collect((0, 0)), version=None)
    assert task_of(session).weights is first


# -------------------------------------------------------------------- heartbeats


def test_new_weights_are_worth_no_heartbeat_of_their_own() -> None:
    session = ready(weights(1))
    assert session.due_s == 1.0
    assert session.tick(0.9) == []


def test_a_heartbeat_lists_the_versions_of_the_weights_held_in_ascending_order() -> None:
    tickets = collect((0, 0), version=2), collect((1, 1), version=5)
    session = ready(*tickets, weights(7), weights(2), weights(5), version=None)
    assert versions_held(session) == (2, 5, 7)


def test_a_heartbeat_every_heartbeat_s_lists_all_tickets() -> None:
    session = ready(collect((7, 0), (8, 1), version=9, keep=(0, 9)))
    session.handle(HeartbeatReply(SESSION, 4, lanes(0, 1)), 0.5)
    session.update_statistics(Statistics(120, {"step": 0.5}, 0))
    assert session.tick(0.9) == []
    (heartbeat,) = sent(session.tick(1.0), Heartbeat)
    assert heartbeat == example(
        Heartbeat, session=SESSION, replies=4, versions=(0,), tickets=(7, 8), steps=120, stages={"step": 0.5}
    )
    assert session.due_s == 2.0


# ---------------------------------------------------------------------------------------------- before there is a run

THREE = DiscreteSpace(3, 0, "int64")
DESCRIPTION = EnvDescription(THREE, THREE, np.zeros(0, np.uint8), "", 0, "")
WAIT = Welcome(SESSION, FIRST, WaitSpec())


def asked(ticket: int, session: int = SESSION) -> Describe:
    return Describe(session, ticket, EnvSpec("Fake-v0"))


def described(ticket: int) -> Described:
    return Described(SESSION, ticket, DESCRIPTION)


def waiting(*messages: ToWorker) -> Session:
    """A session in which the worker waits for the run."""
    session = joining()
    session.tick(0.0)
    for message in (WAIT, *messages):
        session.handle(message, 0.0)
    return session


def test_a_worker_that_waits_says_so_until_a_second_welcome_of_its_session_brings_the_run() -> None:
    session = waiting(HeartbeatReply(SESSION, 3, ()))
    (heartbeat,) = sent(session.tick(session.due_s), Heartbeat)
    assert (heartbeat.waits, heartbeat.replies) == (True, 3)
    assert session.handle(Welcome(SESSION, FIRST, RUN), 1.0) == [BeginRun(RUN)]
    (heartbeat,) = sent(session.tick(session.due_s), Heartbeat)
    assert (heartbeat.waits, heartbeat.replies) == (False, 3)
    for late in (WAIT, Welcome(SESSION, FIRST, RUN)):
        assert session.handle(late, 2.0) == []
        assert session.run == RUN


def test_a_description_is_asked_for_once_and_its_answer_is_sent_again_if_it_was_lost() -> None:
    session = waiting(asked(7))
    assert session.next_work() == asked(7)
    (heartbeat,) = sent(session.tick(session.due_s), Heartbeat)
    assert heartbeat.tickets == (7,)
    assert session.work_ended([described(7)]) == [SendMessage(described(7))]
    (heartbeat,) = sent(session.tick(session.due_s), Heartbeat)
    assert heartbeat.tickets == ()
    assert session.handle(asked(7), 3.0) == [SendMessage(described(7))]
    assert session.next_work() is None


def test_only_the_newest_order_to_describe_counts() -> None:
    session = waiting(asked(7))
    assert session.next_work() == asked(7)
    session.handle(asked(8), 0.0)
    assert session.work_ended([described(7)]) == [], "it is not wanted any more"
    assert session.handle(asked(7), 0.0) == [], "a late copy"
    assert session.next_work() == asked(8)


@pytest.mark.parametrize("begun", [False, True])
def test_a_description_that_is_not_wanted_any_more_is_not_sent(begun: bool) -> None:
    """The run has begun, or the session has ended, while the copy was made."""
    session = waiting(asked(7))
    session.next_work()
    session.handle(Welcome(SESSION, FIRST, RUN) if begun else Rejoin(SESSION), 1.0)
    assert sent(session.work_ended([described(7)]), Described) == []


@pytest.mark.parametrize("message", [collect((7, 0), version=9), asked(7, session=SESSION + 1)])
def test_a_worker_that_waits_takes_no_other_order(message: ToWorker) -> None:
    session = waiting(message)
    assert session.next_work() is None
    (heartbeat,) = sent(session.tick(session.due_s), Heartbeat)
    assert heartbeat.tickets == ()


def test_in_a_run_no_environment_is_described() -> None:
    assert ready(asked(7)).next_work() is None


def test_a_worker_that_waits_leaves_at_once_when_it_is_asked_to() -> None:
    session = waiting()
    assert session.handle(Drain("over"), 1.0) == [SendMessage(Goodbye(SESSION, "over", ())), Leave(0, "over")]


def test_a_heartbeat_reports_what_the_worker_counts() -> None:
    session = ready()
    session.update_statistics(Statistics(5, {"step": 1.5}, 1 << 20))
    (heartbeat,) = sent(session.tick(1.0), Heartbeat)
    assert (heartbeat.steps, heartbeat.stages, heartbeat.resident_bytes) == (5, {"step": 1.5}, 1 << 20)


def test_a_heartbeat_lists_the_ticket_in_progress_and_no_finished_one() -> None:
    session = ready(collect((7, 0), (8, 0)))
    task = task_of(session)
    assert sent(session.tick(1.0), Heartbeat)[0].tickets == (7, 8)
    session.work_ended(fake_rollouts(task))
    assert sent(session.tick(2.0), Heartbeat)[0].tickets == (8,)


# -------------------------------------------------------------------- lanes


def test_a_higher_incarnation_starts_the_lane_anew_with_sequence_0() -> None:
    session = ready(collect((0, 0), (1, 0)))
    collected(session)
    session.handle(collect((2, 0), incarnation=1), 0.1)
    assert held_count(session) == 1  # the ticket and the rollout of the old incarnation are dropped
    (permit,) = task_of(session).permits
    assert (permit.ticket, permit.incarnation, permit.sequence) == (2, 1, 0)


def test_a_rollout_of_a_lane_that_started_anew_while_it_was_collected_is_not_sent() -> None:
    session = ready(collect((0, 0)))
    task = task_of(session)
    session.handle(collect((2, 0), incarnation=1), 0.1)
    assert sent(session.work_ended(fake_rollouts(task)), Rollout) == []
    (permit,) = task_of(session).permits
    assert (permit.ticket, permit.sequence) == (2, 0)


def test_a_ticket_of_an_older_incarnation_is_ignored() -> None:
    session = ready(collect((2, 0), incarnation=1))
    session.handle(collect((1, 0), received=lanes(0, incarnation=1)), 0.1)
    assert held_count(session) == 1
    assert task_of(session).permits[0].ticket == 2


def test_release_closes_the_lane_and_drops_its_tickets_and_rollouts() -> None:
    session = ready(collect((0, 0), (1, 1)))
    collected(session)
    assert session.handle(Release(SESSION, (LaneIncarnation(0, 0),)), 0.1) == [CloseLanes((LaneIncarnation(0, 0),))]
    assert held_count(session) == 1
    assert session.handle(Release(SESSION, (LaneIncarnation(0, 0),)), 0.2) == []  # a repeat


def test_a_release_of_a_later_incarnation_closes_the_one_that_is_here() -> None:
    """The order that would have started the later one was lost."""
    session = ready(collect((0, 0)))
    assert session.handle(Release(SESSION, (LaneIncarnation(0, 1),)), 0.1) == [CloseLanes((LaneIncarnation(0, 0),))]


def test_a_late_release_does_not_close_a_later_incarnation() -> None:
    session = ready(collect((0, 0), incarnation=2))
    assert session.handle(Release(SESSION, (LaneIncarnation(0, 1),)), 0.1) == []
    assert held_count(session) == 1


def test_a_lane_missing_from_a_heartbeat_reply_is_closed() -> None:
    session = ready(collect((0, 0), (1, 1)))
    assert session.handle(HeartbeatReply(SESSION, 1, lanes(1)), 1.0) == [CloseLanes((LaneIncarnation(0, 0),))]


@pytest.mark.parametrize("copy", [HeartbeatReply(SESSION, 1, ()), collect((0, 0))], ids=["HeartbeatReply", "Collect"])
def test_a_late_copy_of_a_message_closes_no_lane_that_came_after_it(copy: ToWorker) -> None:
    """Else the lane would start again in the same incarnation, and count its rollouts from 0 again."""
    session = ready(HeartbeatReply(SESSION, 1, ()), collect((0, 0)), collect((1, 1), received=lanes(0, 1)))
    assert session.handle(copy, 0.2) == []
    assert held_count(session) == 2


def test_a_late_copy_of_an_order_opens_its_released_lane_until_the_next_reply() -> None:
    lane, order = (
        LaneIncarnation(0, 0),
        example(Reset, session=SESSION, ticket=60, copies=(0,), seeds=(None,), options=np.zeros(0, np.uint8)),
    )
    session = joining()
    session.handle(Welcome(SESSION, FIRST, StepSpec((EnvSpec("Any-v0"),), (0,), (1,), (), ())), 0.0)
    session.handle(order, 0.1)
    assert session.handle(Release(SESSION, (lane,)), 0.2) == [CloseLanes((lane,))]
    assert session.handle(order, 0.3) == []
    assert session.next_work() == order
    assert session.handle(HeartbeatReply(SESSION, 1, ()), 0.4) == [CloseLanes((lane,))]


def test_a_rollout_of_a_lane_that_was_released_while_it_was_collected_is_not_sent() -> None:
    session = ready(collect((0, 0), (1, 1)))
    task = task_of(session)
    session.handle(Release(SESSION, (LaneIncarnation(0, 0),)), 0.1)
    assert [rollout.lane for rollout in sent(session.work_ended(fake_rollouts(task)), Rollout)] == [1]


# -------------------------------------------------------------------- sessions


def test_nothing_of_a_session_outlives_it() -> None:
    session = ready(collect((0, 0), (1, 0), (2, 1)))
    rollouts = fake_rollouts(task_of(session))
    session.work_ended(rollouts)
    session.handle(HeartbeatReply(SESSION, 9, lanes(0, 1)), 0.1)
    closed, *_ = session.handle(Rejoin(SESSION), 1.0)
    assert closed == CloseLanes((LaneIncarnation(0, 0), LaneIncarnation(1, 0)))
    assert held_count(session) == 0
    session.handle(Welcome(12, FIRST + 1, RUN), 1.1)
    assert held_count(session) == 0
    assert session.next_work() is None
    (heartbeat,) = sent(session.tick(2.2), Heartbeat)
    assert (heartbeat.session, heartbeat.replies, heartbeat.versions, heartbeat.tickets) == (12, 0, (), ())


def test_a_task_of_an_ended_session_is_abandoned_and_its_rollouts_are_not_sent() -> None:
    session = ready(collect((0, 0)))
    task = task_of(session)
    assert not session.is_unwanted(task)
    session.handle(Rejoin(SESSION), 1.0)
    assert session.is_unwanted(task)
    session.handle(Welcome(12, FIRST + 1, RUN), 1.1)
    assert session.is_unwanted(task)
    session.handle(msgspec.structs.replace(collect((0, 0)), session=12), 1.2)  # the same ticket number again
    assert session.work_ended(fake_rollouts(task)) == []
    assert held_count(session) == 1


def test_a_message_of_another_session_is_ignored() -> None:
    session = ready(collect((0, 0)))
    other = SESSION - 1
    for message in (
        msgspec.structs.replace(collect((5, 0)), session=other),
        HeartbeatReply(other, 7, ()),
        Release(other, (LaneIncarnation(0, 0),)),
        Rejoin(other),
    ):
        assert session.handle(message, 1.0) == []
    assert (session.state, held_count(session)) == (WorkerState.READY, 1)
    assert sent(session.tick(1.0), Heartbeat)[0].replies == 0


def test_a_worker_joins_a_silent_learner_again() -> None:
    session = ready(collect((0, 0)))
    assert sent(session.tick(1.0), Heartbeat)
    assert sent(session.tick(7.0), Heartbeat)
    assert hello_attempt(session.tick(7.1)) == FIRST + 1
    assert (session.state, held_count(session)) == (WorkerState.JOINING, 0)
    session.handle(Welcome(12, FIRST + 1, RUN), 7.2)
    assert sent(session.tick(8.2), Heartbeat), "it has just been heard"


def test_a_learner_that_was_not_spoken_to_is_not_silent() -> None:
    """A constructor may take longer than learner_timeout_s. Meanwhile the worker sends no Heartbeat, so nobody answers."""
    session = ready(collect((0, 0)))
    for now in (100.0, 106.0):
        assert sent(session.tick(now), Heartbeat)
    assert sent(session.tick(106.1), Hello)


@pytest.mark.parametrize(
    "message",
    [weights(1), HeartbeatReply(SESSION, 1, ()), collect((0, 0)), Release(SESSION, ())],
    ids=lambda message: type(message).__name__,
)
def test_any_message_of_the_session_is_a_sign_of_life(message: ToWorker) -> None:
    session = ready()
    session.tick(1.0)
    session.handle(message, 5.0)
    for now in (5.5, 11.5):
        assert sent(session.tick(now), Heartbeat)
    assert sent(session.tick(11.6), Hello)


# -------------------------------------------------------------------- leaving


def test_stop_finishes_the_rollout_in_progress_and_returns_the_other_tickets_in_goodbye() -> None:
    session = ready(collect((0, 0), (1, 0), (2, 1)))
    task = task_of(session)  # tickets 0 and 2
    assert session.stop() == []
    assert session.state is WorkerState.DRAINING
    assert not session.is_unwanted(task)
    *rollouts, goodbye, leave = session.work_ended(fake_rollouts(task))
    assert [rollout.ticket for rollout in sent(rollouts, Rollout)] == [0, 2]
    assert goodbye == SendMessage(Goodbye(SESSION, "told to stop", (1,)))
    assert leave == Leave(0, "told to stop")


def test_an_evaluation_in_progress_is_not_finished_by_a_worker_that_drains() -> None:
    session = ready(EVALUATE)
    task = session.next_work()
    assert isinstance(task, EvaluationTask)
    assert not session.is_unwanted(task)
    session.stop()
    assert session.is_unwanted(task)
    assert session.work_ended([]) == [SendMessage(Goodbye(SESSION, "told to stop", (8,))), Leave(0, "told to stop")]


@pytest.mark.parametrize(("stop", "why"), [(Session.stop, "told to stop"), (drained, "finished")])
def test_who_is_asked_to_leave_without_work_in_progress_leaves_at_once(
    stop: Callable[[Session], list[WorkerEffect]], why: str
) -> None:
    assert stop(joining()) == [Leave(0, why)]
    session = ready(collect((0, 0)))
    assert stop(session) == [SendMessage(Goodbye(SESSION, why, (0,))), Leave(0, why)]
    assert session.state is WorkerState.LEFT


def test_two_stops_leave_at_once() -> None:
    session = ready(collect((0, 0)))
    task = task_of(session)
    session.stop()
    assert session.stop() == [Leave(0, "told to stop")]
    assert session.is_unwanted(task)
    assert session.stop() == []


def test_drain_finishes_the_rollout_in_progress_and_then_leaves() -> None:
    session = ready(collect((0, 0), (1, 0)))
    task = task_of(session)
    assert session.handle(Drain("finished"), 0.1) == []
    assert session.next_work() is None
    effects = session.work_ended(fake_rollouts(task))
    assert len(sent(effects, Rollout)) == 1
    assert effects[-2:] == [SendMessage(Goodbye(SESSION, "finished", (1,))), Leave(0, "finished")]


def test_no_ticket_is_accepted_while_draining() -> None:
    session = ready(collect((0, 0)))
    task = task_of(session)
    session.stop()
    assert session.handle(collect((1, 0), first=1), 0.1) == []
    effects = session.work_ended(fake_rollouts(task))
    assert sent(effects, Goodbye)[0].tickets == ()


def test_heartbeats_go_on_while_draining() -> None:
    session = ready(collect((0, 0)))
    task_of(session)
    session.stop()
    assert sent(session.tick(1.0), Heartbeat)
    session.handle(HeartbeatReply(SESSION, 1, lanes(0)), 5.0)
    assert sent(session.tick(10.0), Heartbeat)


def test_weights_that_come_while_draining_are_listed_so_that_they_are_not_sent_after_each_heartbeat() -> None:
    session = ready(collect((0, 0)))
    task_of(session)
    session.stop()
    session.handle(weights(1), 0.1)
    assert versions_held(session) == (0, 1)


def test_the_drain_that_answers_its_heartbeats_is_a_sign_of_life_to_a_draining_worker() -> None:
    """The rollout in hand takes longer than learner_timeout_s; a draining learner answers each heartbeat by Drain."""
    session = ready(collect((0, 0)))
    task_of(session)
    for second in range(20):
        assert session.handle(Drain("finished"), float(second)) == []
        assert all(not isinstance(effect, Leave) for effect in session.tick(second + 0.5))


def test_a_draining_worker_does_not_wait_for_a_silent_learner() -> None:
    session = ready(collect((0, 0)))
    task_of(session)
    session.stop()
    assert sent(session.tick(1.0), Heartbeat)
    (leave,) = session.tick(7.1)
    assert isinstance(leave, Leave)
    assert "silent" in leave.reason


def test_rejoin_while_draining_leaves() -> None:
    session = ready(collect((0, 0)))
    task_of(session)
    session.stop()
    (leave,) = session.handle(Rejoin(SESSION), 0.1)
    assert isinstance(leave, Leave)


@pytest.mark.parametrize("state", [WorkerState.JOINING, WorkerState.READY, WorkerState.DRAINING])
def test_refuse_leaves_with_exit_code_2_in_every_state(state: WorkerState) -> None:
    session = in_state(state)
    assert session.handle(Refuse("another protocol"), 0.1) == [Leave(2, "another protocol")]
    assert session.state is WorkerState.LEFT


def test_a_failure_is_reported_with_its_traceback_and_leaves_with_exit_code_1() -> None:
    session = ready(collect((0, 3)))
    task_of(session)
    effects = session.fail("ValueError: bad action", "Traceback: …", 3)
    assert effects == [
        SendMessage(example(Failure, session=SESSION, error="ValueError: bad action", traceback="Traceback: …", lane=3)),
        Leave(1, "ValueError: bad action"),
    ]


def test_a_failure_of_the_users_policy_says_so() -> None:
    session = ready(collect((0, 3)))
    task_of(session)
    sent, _ = session.fail("policy Mine: act raised KeyError", "Traceback: …", None, of_policy=True)
    assert sent == SendMessage(
        example(Failure, session=SESSION, error="policy Mine: act raised KeyError", traceback="Traceback: …", of_policy=True)
    )


@pytest.mark.parametrize(
    "leave",
    [
        lambda session: session.fail("boom\n" * 10_000, "a frame\n" * 100_000, None),
        lambda session: session.decline("no display\n" * 10_000),
    ],
    ids=["failed", "declined"],
)
def test_last_words_fit_into_their_message(leave: Callable[[Session], list[WorkerEffect]]) -> None:
    session = ready(collect((0, 3)))
    (said,) = (effect.message for effect in leave(session) if isinstance(effect, SendMessage))
    assert decode_to_learner([bytes(frame) for frame in encode(said)]) == said
    assert session.next_work() is None


def test_a_failure_before_any_session_is_not_reported() -> None:
    assert joining().fail("no such environment", "", None) == [Leave(1, "no such environment")]


def test_a_declined_run_is_left_with_an_exit_code_of_its_own_and_a_goodbye() -> None:
    assert ready().decline("no code") == [SendMessage(Goodbye(SESSION, "no code", ())), Leave(EXIT_UNSUITABLE, "no code")]


def test_a_worker_whose_key_is_refused_leaves_with_exit_code_2_in_every_state() -> None:
    for state in (WorkerState.JOINING, WorkerState.READY, WorkerState.DRAINING):
        session = in_state(state)
        assert session.refused("refused") == [Leave(2, "refused")]
        assert session.state is WorkerState.LEFT
        assert session.refused("refused") == []


def test_a_worker_that_has_left_sends_nothing() -> None:
    session = in_state(WorkerState.LEFT)
    for message in EVERY_MESSAGE:
        assert session.handle(message, 1.0) == []
    assert session.tick(1e6) == session.stop() == session.fail("x", "", None) == []
    assert session.next_work() is None


# -------------------------------------------------------------------- the table

EVERY_MESSAGE = to_worker(SESSION, FIRST)


def in_state(state: WorkerState) -> Session:
    """A session in this state; DRAINING with ticket 0 in hand."""
    if state is WorkerState.JOINING:
        return joining()
    session = ready(collect((0, 0)))
    task_of(session)
    if state in (WorkerState.DRAINING, WorkerState.LEFT):
        session.stop()
    if state is WorkerState.LEFT:
        session.stop()
    assert session.state is state
    return session


@pytest.mark.parametrize("state", WorkerState)
@pytest.mark.parametrize("message", EVERY_MESSAGE, ids=lambda message: type(message).__name__)
def test_a_message_that_the_table_does_not_list_changes_nothing(state: WorkerState, message: ToWorker) -> None:
    session = in_state(state)
    held = held_count(session)
    effects = session.handle(message, 0.1)
    if type(message) not in TABLE[state]:
        assert (effects, session.state, held_count(session)) == ([], state, held)


@pytest.mark.parametrize("state", WorkerState)
@pytest.mark.parametrize("message", EVERY_MESSAGE, ids=lambda message: type(message).__name__)
def test_the_table_names_the_state_that_follows(state: WorkerState, message: ToWorker) -> None:
    session = in_state(state)
    session.handle(message, 0.1)
    assert session.state is TABLE[state].get(type(message), state)


def test_a_worker_sends_only_messages_for_a_learner() -> None:
    kinds = set(ToLearner.__args__)
    session = ready(collect((0, 0)))
    effects = session.work_ended(fake_rollouts(task_of(session))) + session.tick(1.0) + session.stop()
    assert {type(effect.message) for effect in effects if isinstance(effect, SendMessage)} <= kinds


def test_weights_are_held_and_not_copied() -> None:
    parameters = np.zeros(3, np.float32)
    session = ready(Weights(1, parameters, BUFFERS), collect((0, 0), version=1))
    assert task_of(session).weights.parameters is parameters


def test_what_a_worker_misses_is_what_unfinished_tickets_name_and_it_does_not_hold() -> None:
    session = ready()
    assert session.missing_versions() == set()
    session.handle(collect((1, 0), version=1), 0.1)
    session.handle(msgspec.structs.replace(EVALUATE, version=2), 0.1)
    assert session.missing_versions() == {1, 2}
    session.handle(weights(2), 0.2)
    assert session.missing_versions() == {1}
    session.handle(weights(1), 0.4)
    assert session.missing_versions() == set()
    session.handle(collect((2, 1), version=5), 0.6)
    session.handle(Rejoin(session.session), 0.7)
    assert session.missing_versions() == set()
