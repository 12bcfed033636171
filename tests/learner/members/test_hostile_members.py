"""Workers that send too much: the log, the memory and the time that they can take are limited."""

from __future__ import annotations

import logging
from typing import cast

import msgpack
import msgspec
import numpy as np
import pytest

from millrace.learner.members.events import EnvironmentRaised, WorkerLeft, WorkerRefused, describe
from millrace.learner.members.join_limiter import AT_ONCE, PER_S, JoinLimiter
from millrace.learner.members.member_log import OF_A_KEY, OF_A_WORKER, MemberLog
from millrace.learner.members.member_server import TURN_S
from millrace.learner.members.membership import MAX_MEMBERS, REMEMBERED
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.learner.rollouts.hub import Hub, HubSettings
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.lag_statistics import MOST_WORKERS, LagStatistics
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import STRIKES, TicketCoordinator
from millrace.protocol.errors import BadMessage, BadRollout, EnvironmentFailed
from millrace.protocol.messages import (
    Evaluated,
    Failure,
    Goodbye,
    Heartbeat,
    Hello,
    Inquire,
    Refuse,
    Status,
    ToLearner,
    Welcome,
)
from millrace.protocol.rollout import Episode, Rollout
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.token_bucket import TokenBucket
from millrace.protocol.wire.codec import decode_to_learner, decode_to_observer, decode_to_worker, encode
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.workers.copies.env_errors import CopyFailed, environment_failed
from tests.learner.rollouts.test_ticket_coordinator import Learner
from tests.support.conversation.example_messages import example
from tests.support.conversation.extreme_messages import SESSION, extremes, of_session
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, SEATS, fake_rollout, run_spec, seated_rollout
from tests.support.conversation.fake_link import FakeLink
from tests.support.conversation.rules import pending_evaluation


class Noisy:
    """A hub that has one lane, an honest worker that owns it, and a link on which anybody may speak."""

    def __init__(self, max_env_failures: int = 0, **run: object) -> None:
        self.link = FakeLink()
        self.coordinator = TicketCoordinator(
            run_spec(1, **run), RolloutDealer(1, Rounds(0)), worker_timeout_s=5.0, first_session=1
        )
        settings = HubSettings(60.0, 600.0, max_env_failures)
        self.hub = Hub(cast(LearnerLink, self.link), self.coordinator, settings, clock=lambda: self.link.now)
        self.joins("honest")
        self.hub.publish(0, PARAMETERS, BUFFERS)

    def hears(self, peer: str, *messages: ToLearner | Inquire | BadMessage) -> None:
        self.link.inbox += [(peer.encode(), cast(ToLearner, message)) for message in messages]
        while self.link.inbox:
            self.hub.pulse()
            self.link.now += 0.01

    def joins(self, name: str, nonce: int = 1) -> int:
        """The session of this worker."""
        self.hears(name, hello(name, nonce))
        return self.coordinator.members[name.encode()].session


def hello(name: str, nonce: int = 1, host: str = "host", attempt: int = 1) -> Hello:
    return example(Hello, worker=name, host=host, process_nonce=nonce, attempt=nonce + attempt)


def logged(caplog: pytest.LogCaptureFixture) -> int:
    return sum(len(record.getMessage().encode()) for record in caplog.records)


# ---------------------------------------------------------------- the log


@pytest.mark.parametrize("names", [1, 100_000])
def test_a_flood_of_sessions_and_reasons_logs_a_limited_number_of_bytes(
    names: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    noisy = Noisy()
    for number in range(4_000):
        name = f"w{number % names}"
        session = noisy.joins(name, number)
        noisy.hears(name, Goodbye(session, "x" * 1_000, ()))
    limit = OF_A_WORKER if names == 1 else OF_A_KEY
    seconds = 4_000 * 2 * 0.01
    assert logged(caplog) < limit.bytes + seconds * limit.bytes_per_s
    assert len(caplog.records) < limit.lines + seconds * limit.lines_per_s + 2  # two of the honest worker
    noisy.link.now += 10_000
    noisy.joins("later")
    assert "more lines about it, or about workers of the same key, were left out)" in caplog.messages[-1] or names == 1


def test_a_worker_cannot_use_up_the_log_of_another_keys_worker_of_its_name(caplog: pytest.LogCaptureFixture) -> None:
    link = FakeLink()
    link.source = lambda peer: peer.decode()  # type: ignore[method-assign]
    member_log = MemberLog(cast(LearnerLink, link), lambda: 0.0)
    left = WorkerLeft("w0", "left: bye", 0, False)
    for _ in range(10 * OF_A_WORKER.lines):
        member_log.log_event(logging.WARNING, left, describe(left), b"hostile")
    before = len(caplog.records)
    assert before <= OF_A_WORKER.lines
    member_log.log_event(logging.WARNING, left, describe(left), b"honest")
    assert len(caplog.records) == before + 1


def test_a_thousand_honest_workers_are_all_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    noisy = Noisy()
    for number in range(1_000):
        session = noisy.joins(f"w{number}")
        noisy.hears(f"w{number}", Goodbye(session, "told to stop", ()))
    assert len([line for line in caplog.messages if line.startswith("worker w")]) == 2 * 1_000


def test_of_a_failure_that_would_fill_the_log_only_the_line_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    noisy = Noisy()
    for number in range(5):
        session = noisy.joins("spare", number)
        noisy.hears("spare", example(Failure, session=session, error="boom", traceback="y" * (30_000 + number)))
    broke = [line for line in caplog.messages if "boom" in line and "(host)" in line]
    assert ["\n    yyy" in line for line in broke] == [True, True, False, False, False]
    assert "its traceback is left out" in broke[2]


def test_no_line_of_a_traceback_looks_like_a_line_of_the_log() -> None:
    forged = "2026-11-22 05:00:00,000 learner: all is well"
    text = describe(EnvironmentRaised("w", "h", "boom\x9b31m", f"{forged}\n\x1b[2J\r{forged}\u2028{forged}\x85{forged}"))
    first, *more = text.splitlines()
    assert "\x9b" not in first
    assert more
    assert all(line.startswith("    ") for line in more)
    assert "\x1b" not in text


def test_a_failure_names_its_lane_once() -> None:
    error = CopyFailed(1, "step")
    error.__cause__ = ValueError("boom")
    for what in (error, CopyFailed(1, line="boom"), "boom"):
        line = describe(EnvironmentRaised("w", "h", str(environment_failed(0, what, "step 7"))))
        assert line.startswith("worker w (h): lane 0, ")
        assert line.count("lane 0") == 1
    assert describe(EnvironmentRaised("w", "h", "lane 0: boom", "")).count("lane 0") == 1, "it is shown as it came"


def test_a_message_that_cannot_be_read_forges_no_line(caplog: pytest.LogCaptureFixture) -> None:
    noisy = Noisy()
    noisy.hears("spare", BadMessage("array expected, got one\n2026 learner: all is \x1b[31mwell"))
    (line,) = caplog.messages
    assert len(line.splitlines()) == 1
    assert "\x1b" not in line


# ---------------------------------------------------------------- memory


def test_what_is_kept_of_workers_that_left_is_limited() -> None:
    logging.disable(logging.CRITICAL)
    noisy = Noisy()
    stages = noisy.coordinator.membership
    for number in range(REMEMBERED + 500):
        name = f"w{number}"
        session = noisy.joins(name)
        noisy.hears(
            name,
            example(Heartbeat, session=session, versions=(0,), steps=2**53, stages={"step": 1e9}),
            fake_rollout(session, 0, 9, 0, 0),
        )
    honest = noisy.joins("honest", 2)
    for _ in range(20):
        noisy.link.now += 0.4
        noisy.hears("honest", example(Heartbeat, session=honest, versions=(0,)))
    logging.disable(logging.NOTSET)
    assert set(noisy.coordinator.members) == {b"honest"}
    assert len(stages._removed_for_silence) == REMEMBERED
    assert len(noisy.hub.lag_statistics._newest_used) == 0, "a rollout counts for the weights' age only if it was accepted"
    assert stages.stages().keys() == {"step"}
    assert 0 < stages.stages()["step"] < 0.1 * (REMEMBERED + 500), "no session has taken longer than it lasted"


def test_the_stages_of_a_process_that_joins_again_are_counted_once() -> None:
    learner = Learner(lanes=1)
    learner.joins(b"a")
    learner.now = 60.0
    learner.says(
        b"a",
        example(
            Heartbeat,
            session=learner.session(b"a"),
            versions=(0,),
            tickets=tuple(learner.tickets(b"a")),
            steps=1,
            stages={"step": 10.0},
        ),
    )
    learner.says(b"a", hello("a", 4_001, attempt=2))
    for now, step_s, all_s in ((61.0, 10.5, 10.0), (100.0, 30.5, 30.0), (101.0, 0.0, 10.0)):  # what falls is not believed
        learner.now = now
        learner.says(
            b"a",
            example(
                Heartbeat,
                session=learner.session(b"a"),
                versions=(0,),
                tickets=tuple(learner.tickets(b"a")),
                steps=1,
                stages={"step": step_s},
            ),
        )
        assert learner.coordinator.membership.stages() == {"step": all_s}


def test_measurements_of_the_weights_age_are_kept_of_a_limited_number_of_workers() -> None:
    age = LagStatistics()
    age.published(0, 0.0)
    for number in range(3 * MOST_WORKERS):
        age.arrived("honest", 0, 1.0)
        age.arrived(f"w{number}", 0, 2.0)
    assert len(age.first_use_s()) == MOST_WORKERS
    assert "honest" in age.first_use_s()


def test_there_is_a_limit_to_the_number_of_members() -> None:
    learner = Learner(lanes=1)
    for number in range(MAX_MEMBERS):
        learner.joins(b"w%d" % number)
    ((_, answer),) = learner.joins(b"more")
    assert answer == Refuse(f"workers: expected at most {MAX_MEMBERS} at one learner")
    ((_, answer), *_) = learner.joins(b"w7")  # a member asks again
    assert isinstance(answer, Welcome)
    assert len(learner.coordinator.members) == MAX_MEMBERS


def test_a_refusal_is_one_short_line_however_long_its_reason_is() -> None:
    learner = Learner(lanes=1)
    learner.joins(b"a")
    outs = [out for _ in range(STRIKES) for out in learner.coordinator.reject_message(b"a", "rubbish\n" * 1_000, 0.0)]
    ((_, refusal),) = outs
    assert decode_to_worker([bytes(frame) for frame in encode(refusal)]) == refusal
    assert learner.joins(b"a") == [(b"a", refusal)], "what is kept of it is as short"


# ---------------------------------------------------------------- time


def test_a_bucket_spends_a_burst_and_then_a_steady_rate() -> None:
    bucket = TokenBucket(3, 0.5)
    spent = []
    for second in range(10):
        if bucket.holds(1, float(second)):
            bucket.spend(1)
            spent.append(second)
    assert spent == [0, 1, 2, 3, 4, 6, 8]


def test_hellos_of_one_key_beyond_the_limit_are_not_answered_and_those_of_another_are() -> None:
    limiter = JoinLimiter()
    assert all(limiter.admits("loud", 0.0) for _ in range(AT_ONCE))
    assert not limiter.admits("loud", 0.0)
    assert limiter.admits("quiet", 0.0)
    assert [limiter.admits("loud", 1.0) for _ in range(int(PER_S) + 1)] == [True] * int(PER_S) + [False]


def test_a_flood_is_read_for_a_limited_time_and_an_honest_worker_is_not_taken_for_silent() -> None:
    noisy = Noisy()
    hears = noisy.coordinator.receive

    def slowly(peer: bytes, message: ToLearner, now: float) -> object:
        noisy.link.now += 0.01
        return hears(peer, message, now)

    noisy.coordinator.receive = slowly  # type: ignore[method-assign, assignment]
    flood = [(b"spare", cast(ToLearner, example(Heartbeat, session=7, versions=(0,))))] * 1_000
    noisy.link.inbox += [*flood, (b"honest", example(Heartbeat, session=1, versions=(0,)))]
    while noisy.link.inbox:
        began_s, left = noisy.link.now, len(noisy.link.inbox)
        noisy.hub.pulse()
        assert noisy.link.now - began_s <= TURN_S + 0.02
        noisy.link.now += 0.02  # a minibatch: short, so the next pulse may take as long
        assert left - len(noisy.link.inbox) <= 1 + TURN_S / 0.01
        assert b"honest" in noisy.coordinator.members, "silence was judged before all was read"


def test_questions_take_a_limited_part_of_the_time() -> None:
    noisy = Noisy()
    made = []
    status = noisy.hub.status

    def slowly(now: float) -> Status:
        made.append(now)
        noisy.link.now += 0.1
        return status(now)

    noisy.hub.status = slowly  # type: ignore[method-assign]
    noisy.link.sent.clear()
    noisy.hears("asks", *[Inquire()] * 50)
    assert len(noisy.link.sent) == 50
    assert len(made) == 1
    noisy.link.now += 2.0
    noisy.hears("asks", Inquire())
    assert len(made) == 2
    assert decode_to_observer(noisy.link.sent[-1]).workers[0].worker == "honest"


# ---------------------------------------------------------------- errors


def test_an_error_in_the_learner_costs_its_sender_the_membership_and_nothing_else(
    caplog: pytest.LogCaptureFixture,
) -> None:
    noisy = Noisy()
    noisy.joins("spare")
    hears = noisy.coordinator.receive

    def raises(peer: bytes, message: ToLearner, now: float) -> object:
        if peer == b"spare":
            raise ZeroDivisionError("not expected")
        return hears(peer, message, now)

    noisy.coordinator.receive = raises  # type: ignore[method-assign, assignment]
    for _ in range(3):
        noisy.hears("spare", example(Heartbeat, session=2, versions=(0,)))
    assert set(noisy.coordinator.members) == {b"honest"}
    refusal = Refuse("its Heartbeat led to an error in the learner: ZeroDivisionError")
    assert [decode_to_worker(frames) for frames in noisy.link.sent[-3:]] == [refusal] * 3
    assert noisy.hub._server.unexpected_errors == 3
    assert len([record for record in caplog.records if record.exc_info]) == 1


def test_what_a_worker_held_whose_message_led_to_an_error_is_dealt_again() -> None:
    noisy = Noisy()
    spare = noisy.joins("spare")
    hears = noisy.coordinator.receive

    def raises(peer: bytes, message: ToLearner, now: float) -> object:
        if peer == b"honest":
            raise ZeroDivisionError("not expected")
        return hears(peer, message, now)

    noisy.coordinator.receive = raises  # type: ignore[method-assign, assignment]
    noisy.hears("honest", example(Heartbeat, session=1, versions=(0,)))
    noisy.hears("spare", example(Heartbeat, session=spare))
    assert [ticket.peer for ticket in noisy.coordinator.rollouts.held.values()] == [b"spare"]


def test_a_spare_worker_cannot_end_the_run_with_failures() -> None:
    noisy = Noisy(max_env_failures=0)
    for number in range(10):
        session = noisy.joins("spare", number)
        noisy.hears("spare", example(Failure, session=session, error="boom", lane=0))
    noisy.hub._turn(0.0)
    noisy.hears("honest", example(Failure, session=1, error="boom", lane=0))
    with pytest.raises(EnvironmentFailed, match="boom; failure 1 in a row; max_env_failures allows 0 in a row"):
        noisy.hub._turn(0.0)


def test_a_worker_that_only_evaluates_ends_the_run_only_by_failures_in_evaluations() -> None:
    noisy = Noisy(max_env_failures=1)

    def fails(nonce: int) -> None:
        noisy.hears("spare", msgspec.structs.replace(hello("spare", nonce), evaluates=True))
        session = noisy.coordinator.members[b"spare"].session
        noisy.hears("spare", example(Failure, session=session, error="boom", lane=0))

    for nonce in range(10):
        fails(nonce)
    noisy.hub._turn(0.0)
    noisy.hub.begin_evaluation(EvaluationPlan((1,), copies=1, most_steps=9), beside=True)
    for nonce in range(10, 12):
        fails(nonce)
    with pytest.raises(EnvironmentFailed, match="boom; failure 2 in a row; max_env_failures allows 1 in a row"):
        noisy.hub._turn(0.0)


@pytest.mark.parametrize(("apart_s", "ends"), [(3590.0, True), (3600.0, False)])
def test_failures_after_env_steps_end_the_run_if_there_are_too_many_within_an_hour(apart_s: float, ends: bool) -> None:
    noisy = Noisy(max_env_failures=1)  # of one env copy: two within the first hour
    for nonce, later_s in ((2, apart_s), (3, 0.0), (4, 0.0)):
        session = noisy.joins("honest", nonce)
        noisy.hears(
            "honest",
            example(Heartbeat, session=session, versions=(0,), steps=1),
            example(Failure, session=session, error="boom", lane=0),
        )
        noisy.link.now += later_s
    if ends:
        with pytest.raises(EnvironmentFailed, match="boom; failure 2 within an hour; max_env_failures allows 1 "):
            noisy.hub._turn(0.0)
    else:
        noisy.hub._turn(0.0)


@pytest.mark.parametrize("between", ["nothing", "a rollout", "episodes of an evaluation"])
def test_work_between_two_failures_ends_the_row(between: str) -> None:
    noisy = Noisy(max_env_failures=1)
    for nonce in range(2, 12):
        session = noisy.joins("honest", nonce)
        noisy.hears("honest", example(Failure, session=session, error="boom", lane=0))
        session = noisy.joins("honest", 100 * nonce)
        ((number, ticket),) = noisy.coordinator.rollouts.held.items()
        if between == "a rollout":
            noisy.hears("honest", fake_rollout(session, ticket.permit.lane, number, noisy.coordinator.version, 0))
            noisy.hub.gather()
            noisy.hub.publish(noisy.coordinator.version + 1, PARAMETERS, BUFFERS)
        elif between != "nothing":
            noisy.hub.begin_evaluation(EvaluationPlan((1,), copies=1, most_steps=9))
            (asked,) = pending_evaluation(noisy.coordinator).playing
            noisy.hears(
                "honest", example(Evaluated, session=session, ticket=asked, episodes=(Episode(0.0, 1, 0.0),), cut=(False,))
            )
            noisy.coordinator.evaluation.end()
    if between == "nothing":
        with pytest.raises(EnvironmentFailed, match="boom; failure 2 in a row; max_env_failures allows 1 in a row"):
            noisy.hub._turn(0.0)
    else:
        noisy.hub._turn(0.0)


def test_a_failure_is_told_once_and_the_same_traceback_is_not_repeated(caplog: pytest.LogCaptureFixture) -> None:
    noisy = Noisy(max_env_failures=9)
    for nonce, traceback in enumerate(("line 1", "line 1", "line 2", "line 1"), 2):
        session = noisy.joins("honest", nonce)
        caplog.clear()
        noisy.hears("honest", example(Failure, session=session, error="boom", traceback=traceback, lane=0))
        (told,) = (record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING)
        if nonce == 3:
            assert told == "worker honest (host): boom; its traceback is the same as the one before"
        else:
            assert told == f"worker honest (host): boom\n    {traceback}"


def test_a_worker_cannot_blame_a_policy_that_is_not_the_users() -> None:
    noisy = Noisy(max_env_failures=0)
    noisy.hears("honest", example(Failure, session=1, error="boom", of_policy=True))
    with pytest.raises(EnvironmentFailed, match="boom; failure 1 in a row; max_env_failures allows 0 in a row"):
        noisy.hub._turn(0.0)


def test_a_worker_that_fails_before_lanes_are_placed_counts() -> None:
    learner = Learner(lanes=2, publish=False)
    learner.joins(b"a")
    learner.says(b"a", example(Failure, session=learner.session(b"a"), error="no such module"))
    (raised,) = [event for event in learner.coordinator.events if isinstance(event, EnvironmentRaised)]
    assert not raised.spare


def test_what_members_are_told_fits_into_a_message() -> None:
    """Names, hosts and reasons of the greatest length, of as many workers as there may be."""
    noisy = Noisy()
    for number in range(MAX_MEMBERS - 1):
        name = f"{number:0200d}"
        noisy.coordinator.receive(name.encode(), hello(name, number, "h" * 1_000), noisy.link.now)
    noisy.coordinator.events.clear()
    noisy.hears("asks", Inquire())
    status = decode_to_observer(noisy.link.sent[-1])
    assert len(status.workers) + status.workers_left_out == MAX_MEMBERS
    assert all(isinstance(event, WorkerLeft | WorkerRefused) for event in noisy.coordinator.events)
    assert np.isfinite([worker.steps_per_s for worker in status.workers]).all()
    assert msgspec.json.encode(status)


# ---------------------------------------------------------------- what once ended a learner, or filled its log or memory


def as_bytes(noisy: Noisy, name: str, message: ToLearner | Inquire) -> None:
    """Say this on the wire: senders of these messages do not check their bounds."""
    try:
        noisy.hears(name, decode_to_learner([bytes(frame) for frame in encode(message)]))
    except BadMessage as error:
        noisy.hears(name, error)


LONG = 1_048_400  # the head of a message may just be so long


def test_two_workers_with_a_host_of_a_megabyte_do_not_make_the_status_too_long() -> None:
    noisy = Noisy()
    for name in ("a", "b"):
        as_bytes(noisy, name, hello(name, host="h" * LONG))
    as_bytes(noisy, "asks", Inquire())
    assert [worker.worker for worker in decode_to_observer(noisy.link.sent[-1]).workers] == ["honest"]


def test_a_refusal_does_not_quote_a_host_of_a_megabyte() -> None:
    noisy = Noisy()
    for nonce, host in ((1, "h"), (2, "h"), (1, "h"), (2, "h" * LONG), (2, "h" * 1_000), (1, "h")):
        as_bytes(noisy, "a", hello("a", nonce, host))
    refusal = decode_to_worker(noisy.link.sent[-1])
    assert isinstance(refusal, Refuse)
    assert "another process, on hhh" in refusal.reason
    assert len(refusal.reason) <= 1_000


def test_invented_stage_names_are_not_kept() -> None:
    noisy = Noisy()
    for nonce in range(5):
        session = noisy.joins("a", nonce)
        as_bytes(
            noisy, "a", example(Heartbeat, session=session, versions=(0,), stages={f"stage {n}": 1.0 for n in range(45_000)})
        )
        as_bytes(noisy, "a", example(Heartbeat, session=session, versions=(0,), stages={"[/red]": 1.0}))
    assert noisy.coordinator.membership.stages() == {}
    assert noisy.coordinator.rollouts.ledger.messages_bad == 10


def test_goodbyes_with_a_reason_of_a_megabyte_are_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    noisy = Noisy()
    for nonce in range(100):
        as_bytes(noisy, "a", Goodbye(noisy.joins("a", nonce), "x" * 1_000_000, ()))
    assert logged(caplog) < 10_000


@pytest.mark.parametrize("forged", ["h\n2026 learner: forged", "h\x1b[31m", "h\x9b31m", "h\u2028", "h\ud800"])
def test_control_characters_in_a_host_reach_no_log(forged: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    noisy = Noisy()
    head = msgpack.packb(msgspec.to_builtins(hello("a", host=forged)), unicode_errors="surrogatepass")
    with pytest.raises(BadMessage):
        decode_to_learner([head])
    noisy.hears("a", hello("a", host=forged))  # even if it were decoded
    assert all(message.isprintable() for message in caplog.messages)
    assert any("worker a (h" in message for message in caplog.messages)


def test_a_return_that_no_episode_can_have_is_refused() -> None:
    rollout = msgspec.structs.replace(fake_rollout(1, 0, 0, 0, 0), terminated=np.ones((1, 1), bool))
    validate(msgspec.structs.replace(rollout, episodes=(Episode(1e30, 1, 0.1),)), run_spec(lanes=1))
    with pytest.raises(BadRollout, match="episode: expected a finite return of 1 to 1 float32 rewards"):
        validate(msgspec.structs.replace(rollout, episodes=(Episode(1e308, 1, 0.1),)), run_spec(lanes=1), most_steps=1)


@pytest.mark.parametrize("seats", [(), SEATS])
def test_rollouts_with_any_resets_are_counted_and_lead_to_no_error(seats: tuple[str, ...]) -> None:
    """Also in a run that has none, of a session that has ended, and before it is known whose they are."""
    noisy, good = Noisy(seats=seats), seated_rollout(SESSION)
    rollouts, lines = noisy.coordinator.rollouts, noisy.hub._server.member_log
    said: list[str] = []
    lines.warn_limited = lambda peer, line: said.append(line)  # type: ignore[method-assign]
    session = noisy.joins("spare")
    for number, frames in enumerate(extremes(good)):
        try:
            message = decode_to_learner(of_session(frames, session), 10_000_000)
        except BadMessage:
            continue
        assert isinstance(message, Rollout)
        rollouts.late(message)  # neither of them may trust it
        rollouts.reject(noisy.coordinator.members[b"spare"], message)
        noisy.hears("spare", message)
        noisy.hears("honest", example(Heartbeat, session=1, versions=(0,), tickets=(0,)))
        session = noisy.joins("spare", number + 2)
    assert len(said) > 100
    assert all("\n" not in line and len(line) < 1_000 for line in said)
    assert noisy.hub._server.unexpected_errors == 0
    assert set(noisy.coordinator.members) == {b"honest", b"spare"}
    assert 0 <= rollouts.ledger.transitions_invalid < 10**9
