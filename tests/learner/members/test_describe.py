"""The conversation before a run, in which a worker describes the environment: its pure half, and the lobby's deadlines on a
fake clock.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import cast

import msgspec
import numpy as np
import pytest
from gymnasium import spaces

from millrace.learner.members.describe_coordinator import FIRST_TICKET, Accept, DescribeCoordinator, Unknown, accept_any
from millrace.learner.members.events import EnvironmentRaised, Failed, WorkerJoined, WorkerProcessFailed
from millrace.learner.members.lobby import Lobby, LobbySettings
from millrace.learner.members.membership import Gone, Outgoing
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.learner.vector_env.order_coordinator import OrderCoordinator
from millrace.protocol.alive import NO_SLOT, WorkerActivity
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.errors import EnvironmentFailed, NoWorkers, Stalled, UsageError
from millrace.protocol.messages import (
    TOLD_TO_STOP,
    Alive,
    Collect,
    Describe,
    Described,
    Drain,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Refuse,
    ToLearner,
    Weights,
    Welcome,
    WorkerExit,
)
from millrace.protocol.progress import RunProgress
from millrace.protocol.space_spec import BoxSpace, DiscreteSpace, EnvDescription
from millrace.protocol.specs import StepSpec, WaitSpec
from millrace.protocol.wire.codec import decode_to_worker
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.plain_values import pack
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import run_spec
from tests.support.conversation.fake_link import FakeLink
from tests.support.in_process.fake_processes import FakeProcesses

WAIT = WaitSpec()
ENV = EnvSpec("Fake-v0")
A, B = b"w0", b"w1"
NOTHING = np.frombuffer(pack({}), np.uint8)
DESCRIPTION = EnvDescription(DiscreteSpace(3, 0, "int64"), DiscreteSpace(2, 0, "int64"), NOTHING, "", 7, "")
OF_NINE = msgspec.structs.replace(DESCRIPTION, observation=DiscreteSpace(9, 0, "int64"))
BROKEN = msgspec.structs.replace(DESCRIPTION, observation=BoxSpace((2,), "float32", np.ones(3), np.ones(())))
SETTINGS = LobbySettings(WAIT, worker_timeout_s=5, no_workers_timeout_s=60, stall_timeout_s=100, max_env_failures=1)


def coordinator(*, decliners_to_end: int = 1, accept: Accept = accept_any) -> DescribeCoordinator:
    """One that wants to know the environment, and has no members."""
    made = DescribeCoordinator(WAIT, 10, worker_timeout_s=5, decliners_to_end=decliners_to_end)
    assert made.ask(Unknown(ENV, accept=accept)) == []
    return made


def of_three(env: DescribedEnv) -> None:
    """Accepts environments with three observations."""
    if env.observation_space != spaces.Discrete(3):
        raise UsageError(f"expected Discrete(3), got {env.observation_space}")


def hello(name: bytes, nonce: int = 1, attempt: int = 1) -> Hello:
    return example(Hello, worker=name.decode(), process_nonce=nonce, attempt=nonce + attempt)


def join(made: DescribeCoordinator, name: bytes, nonce: int = 1) -> int:
    """The session of a worker that joins."""
    (_, welcome), *orders = made.receive(name, hello(name, nonce), 0.0)
    assert isinstance(welcome, Welcome)
    assert welcome.run == WAIT
    assert [type(order) for _, order in orders] in ([], [Describe])
    return welcome.session


def order(made: DescribeCoordinator, name: bytes) -> int:
    """The ticket of the newest order that this worker was sent."""
    return max(made.members[name].tickets)


def describes(
    made: DescribeCoordinator, name: bytes, nonce: int = 1, description: EnvDescription = DESCRIPTION
) -> list[Outgoing]:
    """What comes of it if this worker joins, is asked for a description and sends this one."""
    session = join(made, name, nonce)
    return made.receive(name, Described(session, order(made, name), description), 1.0)


def beat(session: int, replies: int, tickets: tuple[int, ...] = ()) -> Heartbeat:
    return example(Heartbeat, session=session, replies=replies, tickets=tickets, waits=True)


# -------------------------------------------------------------------------------------------------- the pure half


def test_the_first_that_joins_describes_the_environment_and_the_others_wait() -> None:
    made = coordinator()
    (_, welcome), (peer, asked) = made.receive(A, hello(A), 0.0)
    assert isinstance(welcome, Welcome)
    assert (peer, asked) == (A, Describe(welcome.session, order(made, A), ENV))
    join(made, B)
    assert made.members[B].tickets == {}
    assert made.receive(A, Described(welcome.session, order(made, A), DESCRIPTION), 1.0) == []
    assert made.described is not None
    assert made.described.observation_space == spaces.Discrete(3)
    assert made.described.max_episode_steps == 7
    assert made.members.keys() == {A, B}, "nobody joins again"


def test_a_worker_that_only_evaluates_describes_if_no_other_is_there() -> None:
    made = DescribeCoordinator(WAIT, 10, worker_timeout_s=5, decliners_to_end=1)
    made.receive(A, msgspec.structs.replace(hello(A), evaluates=True), 0.0)
    made.receive(B, hello(B), 0.0)
    ((peer, _),) = made.ask(Unknown(ENV))
    assert peer == B
    made.membership.remove(made.members[B], Gone("left"))
    ((peer, _),) = made.ask_more()
    assert peer == A


def test_when_the_worker_that_describes_is_lost_another_one_is_asked() -> None:
    made = coordinator()
    join(made, A)
    two = join(made, B)
    made.members[B].heard_s = 10.0
    ((peer, asked),) = made.remove_silent(10.0)
    assert (peer, asked) == (B, Describe(two, order(made, B), ENV))


def test_each_worker_that_was_asked_and_is_lost_doubles_the_number_that_describes() -> None:
    """So an environment that fails everywhere is found out soon, however many workers there are."""
    made = coordinator(decliners_to_end=0)
    sessions = [join(made, b"w%d" % number) for number in range(8)]
    asked = []
    for lost in range(3):
        failure = example(Failure, session=sessions[lost], error="OSError: no display")
        asked.append([int(peer[1:]) for peer, _ in made.receive(b"w%d" % lost, failure, 1.0)])
    assert asked == [[1, 2], [3, 4, 5], [6, 7]]


def test_when_no_description_comes_for_long_another_one_is_asked_as_well() -> None:
    """A constructor may hang on one machine only."""
    made = coordinator()
    one, two = join(made, A), join(made, B)
    ticket = order(made, A)
    ((peer, asked),) = made.ask_more()
    assert (peer, asked) == (B, Describe(two, ticket, ENV))
    assert made.ask_more() == [], "nobody is left"
    made.receive(B, Described(two, ticket, DESCRIPTION), 1.0)
    assert made.described is not None
    assert made.receive(A, Described(one, ticket, OF_NINE), 2.0) == []
    assert made.described.observation_space == spaces.Discrete(3)


def test_an_order_that_a_heartbeat_shows_to_be_lost_is_sent_again() -> None:
    made = coordinator()
    session = join(made, A)
    ticket = order(made, A)
    for replies, tickets, again in ((0, (), False), (1, (ticket,), False), (2, (), True), (2, (), False), (4, (), True)):
        out = made.receive(A, beat(session, replies, tickets), 1.0)
        assert [type(message) for _, message in out] == [Describe] * again + [HeartbeatReply], replies
    made.receive(A, Described(session, ticket, DESCRIPTION), 1.0)
    assert [type(message) for _, message in made.receive(A, beat(session, 6), 1.0)] == [HeartbeatReply]


def test_of_two_environments_each_is_described_once_and_a_late_answer_is_not_of_the_second() -> None:
    made = coordinator()
    session = join(made, A)
    late = order(made, A)
    ((_, asked),) = made.ask(Unknown(ENV, render_mode="rgb_array"))
    assert asked == Describe(session, order(made, A), ENV, "loop", "rgb_array")
    made.receive(A, Described(session, late, OF_NINE), 1.0)
    assert made.described is None
    made.receive(A, Described(session, order(made, A), DESCRIPTION), 1.0)
    assert made.described is not None


def test_the_next_environment_is_not_asked_of_a_worker_that_hangs_in_the_one_before() -> None:
    made = coordinator()
    one, two = join(made, A), join(made, B)
    made.ask_more()
    late = order(made, A)
    made.receive(B, Described(two, late, DESCRIPTION), 1.0)
    ((peer, asked),) = made.ask(Unknown(ENV))
    assert (peer, asked) == (B, Describe(two, order(made, B), ENV))
    made.receive(A, Described(one, late, DESCRIPTION), 2.0)
    ((peer, _),) = made.ask(Unknown(ENV))
    assert peer == A, "it has answered, and joined first"


def test_a_worker_whose_order_of_an_earlier_environment_was_lost_is_free() -> None:
    made = coordinator()
    one, two = join(made, A), join(made, B)
    made.ask_more()
    ticket = order(made, A)
    made.receive(B, Described(two, ticket, DESCRIPTION), 1.0)
    assert [type(message) for _, message in made.receive(A, beat(one, 1), 2.0)] == [HeartbeatReply]
    ((peer, _),) = made.ask(Unknown(ENV))
    assert peer == A


def test_a_worker_that_describes_when_the_run_begins_gets_lanes_once_it_has_begun_the_run() -> None:
    made = coordinator()
    one, two = join(made, A), join(made, B)
    made.ask_more()
    made.receive(B, Described(two, order(made, B), DESCRIPTION), 1.0)
    run = TicketCoordinator(run_spec(lanes=2), RolloutDealer(2, Rounds(0)), worker_timeout_s=5, first_session=10)
    run.take_over(made.membership, 2.0)
    run.publish(0, np.zeros(1, np.float32), np.zeros(0, np.float32))
    assert {peer for peer, _ in run.begin_update()} == {B}
    run.receive(A, beat(one, 0), 3.0)
    assert run.members[B].lanes == {0, 1}
    run.receive(A, msgspec.structs.replace(beat(one, 0), waits=False), 4.0)
    assert not run.members[A].describes
    assert any(lane.moving for lane in run.rollouts.lanes), "one of the two moves after its rollout"


def test_a_worker_that_still_describes_is_asked_to_leave_as_others_are() -> None:
    made = coordinator()
    join(made, A)
    run = TicketCoordinator(run_spec(), RolloutDealer(4, Rounds(0)), worker_timeout_s=5, first_session=10)
    run.take_over(made.membership, 2.0)
    assert run.drain("the run is over") == [(A, Drain("the run is over"))]


def test_the_run_begins_in_the_sessions_of_those_that_wait_for_it() -> None:
    made = coordinator(decliners_to_end=0)
    refused = made.receive(A, Goodbye(join(made, A), "no such environment", ()), 1.0)
    session = join(made, B)
    made.receive(B, beat(session, 0), 1.0)
    run = TicketCoordinator(run_spec(), RolloutDealer(4, Rounds(0)), worker_timeout_s=5, first_session=10)
    attempt = made.members[B].hello.attempt
    welcome = (B, Welcome(session, attempt, run_spec()))
    assert run.take_over(made.membership, 100.0) == [welcome]
    assert [event for event in run.events if isinstance(event, WorkerJoined)] == [WorkerJoined("w1", "host", 1)]
    assert run.remove_silent(104.0) == [], "it was not listened to meanwhile"
    assert run.receive(B, hello(B), 104.0) == [welcome], "a Hello that is repeated"
    assert run.receive(A, hello(A), 104.0) == refused, "a process that was refused stays refused"
    (_, told), *_ = run.receive(b"w2", hello(b"w2"), 104.0)
    assert isinstance(told, Welcome)
    assert told.session == session + 1


def test_env_steps_that_a_worker_made_in_an_earlier_run_are_not_counted_in_the_run_that_it_waits_for() -> None:
    made = coordinator()
    session = join(made, A)
    made.receive(A, msgspec.structs.replace(beat(session, 0), steps=20), 1.0)
    made.receive(A, Described(session, order(made, A), DESCRIPTION), 1.0)
    run = TicketCoordinator(run_spec(), RolloutDealer(4, Rounds(0)), worker_timeout_s=5, first_session=10)
    run.take_over(made.membership, 2.0)
    run.publish(0, np.zeros(1, np.float32), np.zeros(0, np.float32))
    assert [type(message) for _, message in run.begin_update()] == [Collect, Weights]
    assert run.collected() == 0


def test_the_welcome_that_brings_the_run_is_sent_again_if_a_heartbeat_shows_that_it_was_lost() -> None:
    made = coordinator()
    session = join(made, A)
    made.receive(A, beat(session, 0), 1.0)
    made.receive(A, Described(session, order(made, A), DESCRIPTION), 1.0)
    run = TicketCoordinator(run_spec(), RolloutDealer(4, Rounds(0)), worker_timeout_s=5, first_session=10)
    run.take_over(made.membership, 2.0)
    run.publish(0, np.zeros(1, np.float32), np.zeros(0, np.float32))
    assert [type(message) for _, message in run.begin_update()] == [Collect, Weights]
    for replies, again in ((0, []), (1, []), (2, [Welcome, Collect, Weights]), (2, [])):
        out = run.receive(A, beat(session, replies), 3.0)
        assert [type(message) for _, message in out] == [*again, HeartbeatReply], replies


def test_a_description_that_comes_after_the_run_has_begun_is_no_mistake() -> None:
    """Of a worker that was asked as well, because the first one took long."""
    for run in (
        TicketCoordinator(run_spec(), RolloutDealer(4, Rounds(0)), worker_timeout_s=5, first_session=10),
        OrderCoordinator(StepSpec((ENV,), (0,), (1,), (), ()), 10),
    ):
        made = coordinator()
        session = join(made, A)
        late = Described(session, order(made, A), DESCRIPTION)
        run.take_over(made.membership, 2.0)
        assert run.receive(A, late, 3.0) == []
        assert A in run.members


def test_a_description_that_cannot_be_read_gets_its_sender_refused_and_another_is_used() -> None:
    made = coordinator(decliners_to_end=0)
    ((peer, refusal),) = describes(made, A, description=BROKEN)
    assert peer == A
    assert isinstance(refusal, Refuse)
    assert "low: expected float32(2,)" in refusal.reason
    assert made.described is None
    assert made.receive(A, hello(A), 1.0) == [(A, refusal)]  # the same process does not come back
    describes(made, B)
    assert made.described is not None


def test_a_description_of_a_worker_of_ours_that_cannot_be_read_ends_the_start_with_the_reason() -> None:
    made = coordinator()
    describes(made, A, description=BROKEN)
    assert "its description of the environment: " in str(made.unsuitable)
    assert "low: expected float32(2,)" in str(made.unsuitable)


def test_a_message_that_exceeds_the_bounds_gets_its_sender_refused() -> None:
    made = coordinator()
    join(made, A)
    ((_, refusal),) = made.reject_message(A, "observation space: expected at most 16777216 elements, got 99999999", 1.0)
    assert isinstance(refusal, Refuse)
    assert not made.membership.members


def test_a_worker_of_ours_that_declines_ends_the_start_with_its_reason() -> None:
    made = coordinator()
    made.receive(A, Goodbye(join(made, A), "environment Fake-v0 is not registered", ()), 1.0)
    assert isinstance(made.unsuitable, UsageError)
    assert str(made.unsuitable) == "environment Fake-v0 is not registered"
    assert not made.membership.take_events()  # the error's line is the only one


def test_a_worker_from_elsewhere_that_declines_is_refused_and_the_learner_waits_on() -> None:
    made = coordinator(decliners_to_end=0)
    made.receive(A, Goodbye(join(made, A), "environment Fake-v0 is not registered", ()), 1.0)
    assert made.unsuitable is None
    ((_, refusal),) = made.receive(A, hello(A), 2.0)
    assert refusal == Refuse("environment Fake-v0 is not registered")
    describes(made, B)
    assert made.described is not None


def test_a_description_that_is_not_accepted_ends_the_start_if_the_worker_is_ours() -> None:
    made = coordinator(accept=of_three)
    describes(made, A, description=OF_NINE)
    assert made.described is None
    assert isinstance(made.unsuitable, UsageError)
    assert str(made.unsuitable) == "expected Discrete(3), got Discrete(9)"
    assert not made.membership.take_events()  # the error's line is the only one


def test_a_worker_from_elsewhere_whose_description_is_not_accepted_is_refused_and_another_is_used() -> None:
    made = coordinator(decliners_to_end=0, accept=of_three)
    ((peer, refusal),) = describes(made, A, description=OF_NINE)
    assert (peer, refusal) == (A, Refuse("expected Discrete(3), got Discrete(9)"))
    assert (made.described, made.unsuitable) == (None, None)
    describes(made, B)
    assert made.described is not None
    assert made.unsuitable is None


def test_once_the_environment_is_described_a_worker_that_declines_ends_nothing() -> None:
    made = coordinator()
    one, two = join(made, A), join(made, B)
    made.receive(A, Described(one, order(made, A), DESCRIPTION), 1.0)
    made.receive(B, Goodbye(two, "environment Fake-v0 is not registered", ()), 1.0)
    assert made.unsuitable is None


def test_the_start_ends_once_all_workers_of_the_launcher_have_declined() -> None:
    made = coordinator(decliners_to_end=2)
    for nonce in (1, 2):  # the first is started again, and counts once
        answer = made.receive(A, Goodbye(join(made, A, nonce), "environment Fake-v0 is not registered", ()), 1.0)
        assert answer == [(A, Refuse("environment Fake-v0 is not registered"))]
        assert made.unsuitable is None
    made.receive(B, Goodbye(join(made, B), "environment Fake-v0 is not registered", ()), 1.0)
    assert isinstance(made.unsuitable, UsageError)
    assert str(made.unsuitable) == "environment Fake-v0 is not registered"


def test_a_worker_that_was_not_asked_ends_nothing() -> None:
    """Neither by failures nor by declining: another worker is busy with the description."""
    made = coordinator(decliners_to_end=2)
    join(made, A)
    for nonce in range(2, 9):
        made.receive(B, example(Failure, session=join(made, B, nonce), error="boom"), 1.0)
        made.receive(b"w%d" % nonce, Goodbye(join(made, b"w%d" % nonce), "no such environment", ()), 1.0)
    failed = [event for event in made.events if isinstance(event, Failed)]
    assert len(failed) == 7
    assert all(event.spare for event in failed)
    assert made.unsuitable is None
    assert made.members.keys() == {A}


@pytest.mark.parametrize("decliners_to_end", [0, 1])
@pytest.mark.parametrize("reason", [TOLD_TO_STOP, f"{NO_SLOT} on here"])
def test_a_worker_that_must_leave_says_nothing_of_the_environment(decliners_to_end: int, reason: str) -> None:
    made = coordinator(decliners_to_end=decliners_to_end)
    made.receive(A, Goodbye(join(made, A), reason, ()), 1.0)
    assert made.unsuitable is None
    assert isinstance(made.receive(A, hello(A), 2.0)[0][1], Welcome)


def test_failures_are_told_and_the_worker_may_come_back() -> None:
    made = coordinator()
    for nonce in (1, 2):
        made.receive(
            A, example(Failure, session=join(made, A, nonce), error="OSError: no display", traceback="where\nit was"), 1.0
        )
    failed = EnvironmentRaised("w0", "host", "OSError: no display", "where\nit was")
    assert [event for event in made.events if isinstance(event, Failed)] == [failed, failed]
    assert made.unsuitable is None


def test_a_process_that_ends_while_it_describes_is_a_failure() -> None:
    made = coordinator()
    why = "ended with exit code 0 in the construction of its environment"
    join(made, A, 1)
    made.process_ended(WorkerExit("w0", 1, why, failed=True))  # a process of this program
    made.process_ended(WorkerExit("w0", 1, why, failed=True))
    made.process_ended(WorkerExit("w1", 1, "ended with exit code 3", failed=True))  # it had not joined
    join(made, A, 2)
    made.receive(b"supervisor", Alive((), (WorkerExit("w0", 3, why, failed=True),)), 1.0)  # not the member's nonce
    failed = WorkerProcessFailed("w0", "host", f"its process {why}")
    assert [event for event in made.events if isinstance(event, Failed)] == [failed]
    made.receive(b"supervisor", Alive((), (WorkerExit("w0", 2, why, failed=True),)), 1.0)
    assert [event for event in made.events if isinstance(event, Failed)] == [failed, failed]


def test_the_status_says_who_is_here() -> None:
    made = coordinator()
    join(made, A)
    answer = made.status(RunProgress(total_steps=500), 1.0)
    assert (answer.env, answer.version, answer.progress.total_steps) == ("Fake-v0", -1, 500)
    assert [worker.worker for worker in answer.workers] == ["w0"]


# -------------------------------------------------------------------------------------------------- the shell


class Ends(Exception):
    """What a test's interrupt raises."""


def shell(
    link: FakeLink, check: Callable[[], None] = lambda: None, processes: WorkerProcesses | None = None
) -> tuple[DescribedEnv, Lobby]:
    lobby = Lobby(cast(LearnerLink, link), processes or FakeProcesses(expected=1), SETTINGS, lambda: link.now)
    return lobby.describe(Unknown(ENV), check), lobby


def saying(link: FakeLink, *messages: Callable[[int], ToLearner], name: bytes = A, nonce: int = 1) -> None:
    """Puts a Hello into the inbox; once it is answered, what the worker says in the session that it was given."""

    def answer(peer: bytes, frames: list[bytes]) -> bool:
        link.sent.append(frames)
        message = decode_to_worker([bytes(frame) for frame in frames])
        if isinstance(message, Welcome):
            link.inbox += [(peer, make(message.session)) for make in messages]
        return True

    link.send = answer  # type: ignore[method-assign, assignment]
    link.inbox.append((name, hello(name, nonce)))


def failure_of(lobby: Lobby) -> Failure:
    """A failure of its only member."""
    (session,) = (member.session for member in lobby._coordinator.members.values())
    return Failure(session, "OSError: no display", "", None)


def test_the_lobby_returns_the_description_and_answers_the_workers_until_the_run_begins() -> None:
    link = FakeLink()
    saying(link, lambda session: Described(session, FIRST_TICKET + 1, DESCRIPTION))
    found, lobby = shell(link)
    assert found.action_space == spaces.Discrete(2)
    (session,) = (member.session for member in lobby._coordinator.members.values())
    link.inbox.append((A, beat(session, 0)))
    lobby.listen()
    assert decode_to_worker([bytes(frame) for frame in link.sent[-1]]) == HeartbeatReply(session, 1, ())
    assert lobby.hand_over().members.keys() == {A}


def test_of_two_descriptions_the_one_that_took_longer_counts() -> None:
    """A worker may still be making the first environment when the second one, which is made faster, is described."""
    link = FakeLink()
    lobby = Lobby(cast(LearnerLink, link), FakeProcesses(expected=1), SETTINGS, lambda: link.now)
    link.inbox.append((A, hello(A)))
    for seconds in (3.0, 1.0):
        at_s = link.now + seconds

        def describe_in_time(at_s: float = at_s) -> None:
            for member in lobby._coordinator.members.values():
                if member.tickets and link.now >= at_s:
                    link.inbox.append((A, Described(member.session, max(member.tickets), DESCRIPTION)))

        lobby.describe(Unknown(ENV), describe_in_time)
    assert lobby.described_in_s == pytest.approx(3.0, abs=0.2)


def joins(link: FakeLink, name: bytes, at_s: float) -> Callable[[], None]:
    """A function that, when called after `at_s` for the first time, sends a worker's Hello to the learner."""
    joined: list[bool] = []

    def join_once() -> None:
        if not joined and link.now >= at_s:
            link.inbox.append((name, hello(name)))
            joined.append(True)

    return join_once


@pytest.mark.parametrize("first_joins", [True, False], ids=["after a lost worker", "as the first worker"])
def test_time_without_workers_is_neither_a_stall_nor_time_of_a_description(first_joins: bool) -> None:
    link = FakeLink()
    settings = replace(SETTINGS, stall_timeout_s=20)
    lobby = Lobby(cast(LearnerLink, link), FakeProcesses(expected=1), settings, lambda: link.now)
    joins_s = link.now + 50.0
    others = [joins(link, A, link.now)] if first_joins else []  # it stays silent after its Hello
    turns = [*others, joins(link, B, joins_s)]

    def join_and_describe() -> None:
        for turn in turns:
            turn()
        for peer, member in lobby._coordinator.members.items():
            if peer == B and member.tickets and link.now >= joins_s + 3.0:
                link.inbox.append((B, Described(member.session, max(member.tickets), DESCRIPTION)))

    lobby.describe(Unknown(ENV), join_and_describe)
    assert lobby.described_in_s == pytest.approx(3.0, abs=0.2)


def test_workers_that_join_and_die_one_after_the_other_stall_the_start() -> None:
    """Each is silent for 5 s before it counts as lost. Its successor joins 15 s later."""
    link = FakeLink()
    lobby = Lobby(
        cast(LearnerLink, link), FakeProcesses(expected=1), replace(SETTINGS, stall_timeout_s=18), lambda: link.now
    )
    began_s = link.now
    turns = [joins(link, b"w%d" % n, began_s + 20.0 * n) for n in range(9)]

    def join() -> None:
        for turn in turns:
            turn()

    with pytest.raises(Stalled, match="no description of the environment within 18 s"):
        lobby.describe(Unknown(ENV), join)
    assert link.now - began_s == pytest.approx(63, abs=2), "the time of the fourth worker: three others took 15 s together"


@pytest.mark.parametrize("lives_s", [(20.3,), (10.0, 11.0, 12.0)], ids=["timeout", "crashes"])
def test_time_in_the_environments_code_is_no_stall_even_after_its_worker_was_lost(lives_s: tuple[float, ...]) -> None:
    """Each worker dies while it makes the environment, and is restarted. The last one describes the environment."""
    link = FakeLink()
    began_s = link.now
    dies_s = [began_s + sum(lives_s[: n + 1]) for n in range(len(lives_s))]

    def process() -> int:
        """The number of the worker's process."""
        return sum(link.now >= at_s for at_s in dies_s) + 1

    joined: list[int] = []

    def ended() -> list[WorkerExit]:
        died = joined[-1:] if joined and joined[-1] < process() else []
        return [WorkerExit("w0", nonce, "ended in the construction of its environment", failed=True) for nonce in died]

    processes = FakeProcesses(
        expected=1, of_ended=ended, of_activities=lambda: [WorkerActivity("w0", process(), "describing", 0.0, 0)]
    )
    settings = replace(SETTINGS, stall_timeout_s=20, max_env_failures=3)
    lobby = Lobby(cast(LearnerLink, link), processes, settings, lambda: link.now)

    def join_and_describe() -> None:
        if process() not in joined:
            link.inbox.append((A, hello(A, process())))
            joined.append(process())
        for member in lobby._coordinator.members.values():
            if member.tickets and link.now >= dies_s[-1] + 10.0:
                link.inbox.append((A, Described(member.session, max(member.tickets), DESCRIPTION)))

    lobby.describe(Unknown(ENV), join_and_describe)
    assert link.now - dies_s[-1] == pytest.approx(10.0, abs=0.2)


def test_more_workers_describe_only_once_those_that_joined_have_had_time_to() -> None:
    """The log mentions the wait earlier, because it counts the time without workers too."""
    link = FakeLink()
    lobby = Lobby(cast(LearnerLink, link), FakeProcesses(expected=2), SETTINGS, lambda: link.now)
    joins_s = link.now + 29.5  # half a second before the first line in the log
    turns = [joins(link, A, joins_s), joins(link, B, joins_s + 0.1)]
    asked: list[tuple[float, int]] = []  # since both joined, and how many workers are asked

    def join_and_stay() -> None:
        for turn in turns:
            turn()
        members = lobby._coordinator.members
        link.inbox += [(peer, example(Heartbeat, session=member.session)) for peer, member in members.items()]
        link.now += 0.05
        asked.append((link.now - joins_s, sum(bool(member.tickets) for member in members.values())))
        if link.now >= joins_s + 32.0:
            raise Ends

    with pytest.raises(Ends):
        lobby.describe(Unknown(ENV), join_and_stay)
    assert {workers for seconds, workers in asked if 1.0 < seconds < 29.5} == {1}
    assert asked[-1][1] == 2


def test_a_start_whose_workers_all_die_after_the_description_ends_at_once() -> None:
    """The learner imports PyTorch meanwhile, and answers them."""
    link = FakeLink()
    left = [1.0]
    saying(link, lambda session: Described(session, FIRST_TICKET + 1, DESCRIPTION))
    ended = WorkerExit("w0", 1, "was killed by signal 9", failed=True)
    processes = FakeProcesses(of_ended=lambda: [] if left[0] else [ended], of_left=lambda collecting: left[0], expected=1)
    _, lobby = shell(link, processes=processes)
    lobby.listen()
    left[0] = 0.0
    line = "no worker is left, and none will be started again: the last one was killed by signal 9"
    with pytest.raises(NoWorkers, match=f"^{line}$"):
        lobby.listen()


def test_the_status_says_how_far_the_run_is_who_is_here_and_what_is_awaited() -> None:
    link = FakeLink()
    settings = replace(SETTINGS, progress=RunProgress(env_steps=400, total_steps=500))
    lobby = Lobby(cast(LearnerLink, link), FakeProcesses(expected=2), settings, lambda: link.now)
    assert lobby.status(link.now).progress.waiting == "waiting for a worker to join at fake"
    link.inbox.append((A, hello(A)))
    lobby.listen()
    progress = lobby.status(link.now).progress
    assert (progress.env_steps, progress.total_steps, progress.phase) == (400, 500, "starting")
    assert (progress.workers_alive, progress.workers_expected) == (1, 2)
    assert progress.waiting.startswith("waiting for a description of the environment: worker w0 on host: ")


def test_failures_after_the_description_end_nothing() -> None:
    """Whoever fails then was asked for nothing. If the environment is at fault, the worker fails in its lane."""
    link = FakeLink()
    saying(link, lambda session: Described(session, FIRST_TICKET + 1, DESCRIPTION))
    _, lobby = shell(link)
    link.send = lambda peer, frames: True  # type: ignore[method-assign]
    for nonce in range(2, 9):
        link.inbox += [(A, failure_of(lobby)), (A, hello(A, nonce))]
        lobby.listen()


def test_one_failure_too_many_ends_the_start() -> None:
    link = FakeLink()
    failure, again = ("OSError: no display", "where\nit was", None), [hello(A, 2)]
    goodbye = Goodbye(0, "of a session that has ended", ())
    saying(link, lambda session: Failure(session, *failure), lambda session: again.pop() if again else goodbye)
    line = "worker w0 (host): OSError: no display; failure 2 in a row; max_env_failures allows 1 in a row"
    with pytest.raises(EnvironmentFailed, match=f"^{re.escape(line)}$") as raised:
        shell(link)
    assert raised.value.detail == "where\nit was"


def test_nobody_comes() -> None:
    link = FakeLink()
    with pytest.raises(NoWorkers, match="waited 60 s for 1 worker at fake, 0 joined"):
        shell(link)
    assert 160.0 <= link.now <= 161.0


def test_a_worker_that_never_answers_stalls_the_start(caplog: pytest.LogCaptureFixture) -> None:
    link = FakeLink()
    saying(link)
    beat = FakeProcesses(of_ended=lambda: _heartbeats(link), expected=1)
    with pytest.raises(Stalled, match=r"no description of the environment within 100 s; worker w0 on host: "):
        shell(link, processes=beat)
    lines = [record.getMessage() for record in caplog.records if "no env steps" in record.getMessage()]
    assert lines == [
        "no env steps for 30 s: worker w0 on host: no env step yet",
        "no env steps for 90 s: worker w0 on host: no env step yet",
    ]


def test_what_the_workers_do_and_write_is_told_before_any_has_joined(caplog: pytest.LogCaptureFixture) -> None:
    link = FakeLink()
    making = WorkerActivity("w0", 1, "making", 28.0, 0)
    processes = FakeProcesses(of_activities=lambda: [making], of_last_lines={"w0": "no licence yet"}, expected=1)
    with pytest.raises(NoWorkers):
        shell(link, processes=processes)
    told = [record.getMessage() for record in caplog.records if "no env steps" in record.getMessage()]
    assert told[0] == "no env steps for 30 s: worker w0: in construction for 28 s; w0 wrote: no licence yet"


def _heartbeats(link: FakeLink) -> tuple[()]:
    """The worker's heartbeat, whenever the server looks."""
    for frames in link.sent:
        message = decode_to_worker([bytes(frame) for frame in frames])
        if isinstance(message, Welcome):
            link.inbox.append((A, example(Heartbeat, session=message.session)))
            link.now += 0.5
    return ()


def test_an_interrupt_ends_the_wait_at_once() -> None:
    link = FakeLink()

    def check() -> None:
        if link.now > 101.0:
            raise Ends

    with pytest.raises(Ends):
        shell(link, check)
    assert link.now <= 101.2


def test_the_error_of_a_worker_of_ours_is_raised() -> None:
    link = FakeLink()
    saying(link, lambda session: Goodbye(session, "environment Fake-v0: no such", ()))
    with pytest.raises(UsageError, match="environment Fake-v0: no such"):
        shell(link)
