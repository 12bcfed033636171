"""The pure core of `millrace conform`: deadlines, results and their words, with a clock that the tests move."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from millrace.extras.conformance import collect_checks, mends
from millrace.extras.conformance.examiner import CHECK_S, Check, Examiner
from millrace.extras.conformance.join_checks import leaves_when_refused_later, says_hello, wait_spec
from millrace.extras.conformance.learner import Learner, Settings
from millrace.extras.conformance.mends import MENDS
from millrace.extras.conformance.profiles import PROFILES
from millrace.extras.conformance.report import as_data, explanation, line_of, summary
from millrace.extras.conformance.script import (
    Broken,
    EndClient,
    Ended,
    Heard,
    LearnerEffect,
    Script,
    SendFrames,
    Skipped,
    StartClient,
    Wait,
)
from millrace.extras.conformance.watch import WatchedSession, check_stepped
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import BadMessage
from millrace.protocol.keys.keys import Key, Token
from millrace.protocol.messages import (
    Collect,
    Describe,
    Described,
    Drain,
    Evaluate,
    Goodbye,
    Heartbeat,
    Hello,
    LaneIncarnation,
    Permit,
    Received,
    Release,
    Rollout,
    Step,
    Stepped,
    ToWorker,
    Weights,
    Welcome,
)
from millrace.protocol.rules import Rule
from millrace.protocol.specs import Leaf, StepSpec, WaitSpec
from millrace.protocol.wire.codec import decode_to_worker
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import fake_rollout, run_spec

SETTINGS = Settings(EnvSpec("CartPole-v1"))
STEPPED = StepSpec((EnvSpec("own"),), (0, 0), (2,), (Leaf("", "multibinary", (), "int8"),), ())
STEPPED_ANSWER = example(
    Stepped,
    session=1,
    ticket=7,
    obs=(np.ones(2, np.int8),),
    reward=np.zeros(2),
    terminated=np.zeros(2, bool),
    truncated=np.zeros(2, bool),
    infos=np.zeros(0, np.uint8),
)
TAGGED = b"w\0" + hashlib.blake2b(b"w", key=b"k" * 32, digest_size=16).hexdigest().encode()
HELLO = example(Hello, worker="w", process_nonce=70, software="test", attempt=71)


def examiner(*scripts: Callable[[Learner], Script[None]], limit_s: float = 300.0) -> Examiner:
    return Examiner([Check(script.__name__, script) for script in scripts], SETTINGS, 0.0, limit_s)


def passes(learner: Learner) -> Script[None]:
    yield Wait(0.0)


def breaks(learner: Learner) -> Script[None]:
    yield Wait(0.0)
    raise Broken(Rule.REFUSE, "exit code 2", "exit code 0")


def skips(learner: Learner) -> Script[None]:
    yield Wait(0.0)
    raise Skipped("the environment has no time limit")


def waits_for_ever(learner: Learner) -> Script[None]:
    while True:
        yield Wait(1.0)


def in_a_session(learner: Learner) -> Script[None]:
    yield from learner.newly_started()
    learner.welcome(wait_spec(learner))
    yield Wait(30.0)


def run(test: Examiner, until_s: float, step_s: float = 0.1) -> list[LearnerEffect]:
    """Let the time pass; the client says nothing."""
    effects, now = [], 0.0
    while now < until_s and not test.done:
        effects += test.tick(now)
        now += step_s
    return effects


def test_each_check_has_one_result_in_order() -> None:
    test = examiner(passes, breaks, skips, passes)
    run(test, 5.0)
    assert [each.outcome for each in test.results] == ["passed", "failed", "skipped", "passed"]


def test_a_client_that_says_nothing_has_a_deadline_and_is_ended() -> None:
    test = examiner(PROFILES["environment"][0].script, passes)
    effects = run(test, 100.0)
    result, other = test.results
    assert (other.outcome, other.note) == ("skipped", "the client never said Hello")
    assert (result.outcome, result.rule) == ("failed", Rule.HELLO)
    assert SETTINGS.start_s <= result.seconds < SETTINGS.start_s + 1
    assert effects == [StartClient(), EndClient()]


def test_a_check_that_does_not_end_is_cut() -> None:
    test = examiner(waits_for_ever, passes)
    run(test, 100.0)
    assert [(each.outcome, each.rule) for each in test.results] == [("failed", None), ("passed", None)]
    assert CHECK_S <= test.results[0].seconds < CHECK_S + 1


def test_what_is_not_checked_within_the_limit_has_failed() -> None:
    test = examiner(passes, waits_for_ever, passes, limit_s=3.0)
    run(test, 100.0)
    assert [each.outcome for each in test.results] == ["passed", "failed", "failed"]
    assert test.results[2].got == "no time left"


def sends_what_cannot_be_read(learner: Learner) -> Script[None]:
    yield from learner.newly_started()
    learner.welcome(wait_spec(learner))
    learner.send_unreadable(7, [b"\xc1"])
    yield Wait(30.0)


def welcomed(script: Callable[[Learner], Script[None]] = in_a_session) -> tuple[Examiner, int]:
    test = examiner(script)
    test.tick(0.0)
    sent, *_ = test.handle(Heard(b"w", HELLO), 0.1)
    assert isinstance(sent, SendFrames)
    welcome = decode_to_worker(list(sent.frames))
    assert isinstance(welcome, Welcome)
    return test, welcome.session


def beat(session: int, replies: int = 0) -> Heartbeat:
    return example(Heartbeat, session=session, replies=replies, waits=True)


def test_a_heartbeat_that_is_missing_breaks_a_rule() -> None:
    test, session = welcomed()
    now = 0.1
    while now < 3.0:
        test.handle(Heard(b"w", beat(session)), now)
        test.tick(now)
        now += 0.25
    assert not test.results
    run(test, now + 2.5)
    assert test.results[0].rule == Rule.HEARTBEAT


@pytest.mark.parametrize(
    ("event", "rule"),
    [
        (Heard(b"w", beat(5)), Rule.SESSION),
        (Heard(b"w", BadMessage("head expected at most 1048576 bytes, got 2000000")), Rule.LIMITS),
        (Heard(b"w", BadMessage("head is not a message of ours")), Rule.FRAMES),
        (Ended(3, "Segmentation fault"), Rule.STAYS),
    ],
)
def test_what_breaks_a_rule_of_every_session_fails_the_check_at_once(event: Heard | Ended, rule: Rule) -> None:
    test, _ = welcomed()
    test.handle(event, 0.2)
    assert test.results[0].rule == rule
    if isinstance(event, Ended):
        assert "Segmentation fault" in test.results[0].got


@pytest.mark.parametrize("kind", [Stepped, Rollout])
def test_an_answer_to_what_cannot_be_read_breaks_the_rule_for_that(kind: type[Stepped | Rollout]) -> None:
    test, session = welcomed(sends_what_cannot_be_read)
    none: Any = None
    fields = dict.fromkeys(kind.__struct_fields__, none) | {"session": session, "ticket": 7}
    test.handle(Heard(b"w", kind(**fields)), 0.2)
    assert test.results[0].rule == Rule.IGNORE_UNREADABLE


def test_a_rollout_that_answers_the_last_word_of_a_check_at_once_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    def in_a_run(learner: Learner) -> Script[collect_checks.Collecting]:
        yield from learner.newly_started()
        learner.welcome(run_spec())
        return collect_checks.Collecting(learner, run_spec())

    monkeypatch.setattr(collect_checks, "collecting", in_a_run)
    monkeypatch.setattr(WatchedSession, "see", lambda *seen: None)  # what is in the rollout does not matter here
    test, session = welcomed(collect_checks.ignores_a_late_reply)
    collect = test.handle(Heard(b"w", beat(session)), 0.2)[1]
    assert isinstance(collect, SendFrames)
    dealt = decode_to_worker(list(collect.frames))
    assert isinstance(dealt, Collect)
    test.tick(0.6)
    test.handle(Heard(b"w", fake_rollout(session, 0, dealt.permits[0].ticket, 2, 0)), 0.6)
    assert [each.outcome for each in test.results] == ["passed"]


def test_a_client_may_end_at_once_when_it_is_refused() -> None:
    test, session = welcomed(leaves_when_refused_later)
    test.handle(Heard(b"w", beat(session)), 0.2)
    test.handle(Ended(2, ""), 0.2)
    assert [each.outcome for each in test.results] == ["passed"]


def watch_of(*versions: int) -> WatchedSession:
    """The watch over a session in which these weights were sent."""
    watch = WatchedSession(Welcome(1, 71, run_spec()), 0.0)
    for version in versions:
        watch.sent(Weights(version, np.zeros(1, np.float32), np.zeros(0, np.float32)))
    return watch


@pytest.mark.parametrize("versions", [(5, 3), (3, 3), (3, 4)])
def test_a_heartbeat_lists_versions_that_were_sent_in_ascending_order(versions: tuple[int, ...]) -> None:
    with pytest.raises(Broken) as broken:
        watch_of(5, 3).see(example(Heartbeat, session=1, versions=versions), 0.1)
    assert (broken.value.rule, broken.value.got) == (Rule.HEARTBEAT_VERSIONS, str([*versions]))


@pytest.mark.parametrize(
    ("sent", "version", "sequence", "rule"),
    [
        ((3, 5), 5, 0, Rule.VERSION),  # another than its Collect names, though a newer one
        ((5,), 3, 0, Rule.VERSION),  # before the weights
        ((3, 5), 3, 1, Rule.SEQUENCE),  # another than that of its permit
    ],
)
def test_a_rollout_is_that_of_its_permit(sent: tuple[int, ...], version: int, sequence: int, rule: Rule) -> None:
    watch = watch_of(*sent)
    watch.sent(example(Collect, session=1, version=3, permits=(example(Permit, ticket=7),), keep=(3,)))
    with pytest.raises(Broken) as broken:
        watch.see(fake_rollout(1, 0, 7, version, sequence), 0.1)
    assert broken.value.rule is rule


def test_a_rollout_does_not_come_before_an_earlier_one_of_its_lane() -> None:
    watch = watch_of(3)
    watch.sent(
        example(
            Collect,
            session=1,
            version=3,
            permits=(example(Permit, ticket=7), example(Permit, ticket=8, sequence=1)),
            keep=(3,),
        )
    )
    with pytest.raises(Broken) as broken:
        watch.see(fake_rollout(1, 0, 8, 3, 1), 0.1)
    assert (broken.value.rule, broken.value.got) == (Rule.IN_ORDER, "sequence 1")


def test_a_permit_of_a_lower_incarnation_is_not_answered() -> None:
    watch = watch_of(3)
    watch.sent(
        example(
            Collect,
            session=1,
            version=3,
            permits=(example(Permit, ticket=7, incarnation=2), example(Permit, ticket=8, incarnation=1)),
            keep=(3,),
        )
    )
    with pytest.raises(Broken) as broken:
        watch.see(fake_rollout(1, 0, 8, 3, 0), 0.1)
    assert broken.value.rule is Rule.INCARNATION


def test_a_lane_is_listed_with_what_has_arrived_until_it_is_released() -> None:
    watch = watch_of(3)
    watch.sent(
        example(
            Collect,
            session=1,
            version=3,
            permits=(example(Permit, ticket=7, incarnation=2), example(Permit, ticket=8, lane=1)),
            keep=(3,),
        )
    )
    watch._next_sequence[0, 2] = 1
    assert watch.received() == (Received(0, 2, 1), Received(1, 0, 0))
    watch.confirms = False
    assert watch.received() == (Received(0, 2, 0), Received(1, 0, 0))
    watch.sent(Release(5, (LaneIncarnation(0, 2),)))  # of another session
    assert len(watch.received()) == 2
    watch.sent(Release(1, (LaneIncarnation(0, 2),)))
    assert watch.received() == (Received(1, 0, 0),)


@pytest.mark.parametrize("kind", ["order", "permit", "evaluation"])
def test_a_ticket_is_listed_from_the_reply_after_it_until_it_is_answered(kind: str) -> None:
    watch = WatchedSession(Welcome(1, 71, STEPPED), 0.0) if kind == "order" else watch_of(3)
    sent: dict[str, ToWorker] = {
        "order": example(Step, session=1, ticket=7),
        "permit": example(Collect, session=1, version=3, permits=(example(Permit, ticket=7, sequence=1),), keep=(3,)),
        "evaluation": example(Evaluate, session=1, ticket=7, version=3, greedy=True, most_steps=9),
    }
    watch.sent(watch.reply(1))
    watch.sent(sent[kind])
    for replies, tickets in ((1, ()), (1, ()), (1, (7,))):  # the ticket may be on its way
        watch.see(example(Heartbeat, session=1, replies=replies, tickets=tickets), 0.1)
    watch.sent(watch.reply(2))
    for tickets in ((), (7,), ()):  # two threads of the client may be late by one Heartbeat
        watch.see(example(Heartbeat, session=1, replies=2, tickets=tickets), 0.2)
    with pytest.raises(Broken) as broken:
        watch.see(example(Heartbeat, session=1, replies=2), 0.3)
    assert (broken.value.rule, broken.value.got) == (Rule.HEARTBEAT_TICKETS, "[]")


@pytest.mark.parametrize("why", ["answered", "lost", "drained", "superseded", "of a released lane"])
def test_a_ticket_need_not_be_listed(why: str) -> None:
    watch = WatchedSession(Welcome(1, 71, STEPPED), 0.0)
    if why == "drained":
        watch.sent(Drain(""))
    watch.sent(example(Step, session=1, ticket=7))
    match why:
        case "answered":
            watch.see(STEPPED_ANSWER, 0.1)
        case "lost":
            watch.loses()
        case "superseded":
            watch.sent(example(Step, session=1, ticket=8))
        case "of a released lane":
            watch.sent(Release(1, (LaneIncarnation(0, 0),)))
    watch.sent(watch.reply(1))
    for _ in range(3):
        watch.see(example(Heartbeat, session=1, replies=1, tickets=(8,) if why == "superseded" else ()), 0.2)


def test_with_keys_a_routing_id_is_the_name_and_the_tag_of_the_client() -> None:
    token = Token(b"s" * 32, Key(b"p" * 32, b"k" * 32))
    for routing_id, rule in ((TAGGED, None), (b"w", Rule.ROUTING_ID), (b"w\0" + b"0" * 32, Rule.ROUTING_ID)):
        test = Examiner([Check("", says_hello)], replace(SETTINGS, token=token), 0.0, 300.0)
        test.tick(0.0)
        test.handle(Heard(routing_id + b"\0" + b"its public key", HELLO), 0.1)
        assert test.results[0].rule is rule


def test_an_answer_that_is_sent_again_is_the_same() -> None:
    watch = WatchedSession(Welcome(1, 71, STEPPED), 0.0)
    order = example(Step, session=1, ticket=7)
    for _ in range(3):
        watch.sent(order)
    watch.see(STEPPED_ANSWER, 0.1)
    watch.see(msgspec.structs.replace(STEPPED_ANSWER, reward=np.zeros(2)), 0.2)
    with pytest.raises(Broken) as broken:
        watch.see(msgspec.structs.replace(STEPPED_ANSWER, infos=np.ones(1, np.uint8)), 0.3)
    assert (broken.value.rule, broken.value.got) == (Rule.ORDER_ONCE, "another infos")


def test_a_description_that_is_sent_again_is_the_same() -> None:
    watch = WatchedSession(Welcome(1, 71, WaitSpec()), 0.0)
    description: Any
    for description in ("one", "one"):
        watch.sent(Describe(1, 7, EnvSpec("own")))
        watch.see(Described(1, 7, description), 0.1)
    watch.sent(Describe(1, 7, EnvSpec("own")))
    description = "other"
    with pytest.raises(Broken) as broken:
        watch.see(Described(1, 7, description), 0.2)
    assert broken.value.rule is Rule.DESCRIBE_AGAIN


@pytest.mark.parametrize("ticket", [7, 8], ids=["too often", "of no order"])
def test_a_description_answers_an_order(ticket: int) -> None:
    watch = WatchedSession(Welcome(1, 71, WaitSpec()), 0.0)
    watch.sent(Describe(1, 7, EnvSpec("own")))
    description: Any = "one"
    watch.see(Described(1, 7, description), 0.1)
    with pytest.raises(Broken) as broken:
        watch.see(Described(1, ticket, description), 0.2)
    assert broken.value.rule is Rule.DESCRIBE


def test_a_heartbeat_says_that_the_worker_waits_until_it_must_have_heard_of_the_run() -> None:
    watch = WatchedSession(Welcome(1, 71, WaitSpec()), 0.0)
    late = example(Heartbeat, session=1, waits=True)
    watch.see(late, 0.1)
    with pytest.raises(Broken) as broken:
        watch.see(msgspec.structs.replace(late, waits=False), 0.2)
    assert broken.value.rule is Rule.HEARTBEAT_WAITS
    watch.sent(Welcome(1, 71, run_spec()))
    watch.see(late, 0.3)
    watch.sent(watch.reply(1))
    with pytest.raises(Broken) as broken:
        watch.see(msgspec.structs.replace(late, replies=1), 0.4)
    assert broken.value.rule is Rule.HEARTBEAT_WAITS


def test_last_words_of_a_process_that_was_ended_do_not_count_for_the_next() -> None:
    def starts_again(learner: Learner) -> Script[None]:
        yield from learner.newly_started()
        learner.welcome(run_spec())
        yield Wait(0.5)
        yield from learner.newly_started()

    test, session = welcomed(starts_again)
    test.tick(0.6)
    test.handle(Heard(b"w", Goodbye(session, "it was told to stop", ())), 0.7)
    test.handle(Heard(b"w", HELLO), 0.8)
    assert [each.outcome for each in test.results] == ["passed"]


def test_a_reply_that_was_never_sent_is_noticed() -> None:
    test, session = welcomed()
    test.handle(Heard(b"w", beat(session)), 0.2)
    test.handle(Heard(b"w", beat(session, replies=1)), 0.4)
    assert not test.results
    test.handle(Heard(b"w", beat(session, replies=9)), 0.6)
    assert test.results[0].rule == Rule.HEARTBEAT_REPLIES


def test_what_another_worker_of_the_command_says_is_not_looked_at() -> None:
    test, _ = welcomed()
    test.handle(Heard(b"other", beat(5)), 0.2)
    test.handle(Heard(b"other", example(Hello, worker="other", pid=2, process_nonce=80, software="test", attempt=81)), 0.2)
    assert not test.results


def test_the_report_has_the_rule_and_where_it_stands() -> None:
    test = examiner(passes, breaks, breaks, skips)
    run(test, 5.0)
    passed, failed, again, skipped = test.results
    assert line_of(passed) == "ok       passes"
    assert line_of(skipped) == "skipped  skips  (the environment has no time limit)"
    text = " ".join(" ".join(explanation(failed)).split())
    assert text == (
        f"rule REFUSE: {Rule.REFUSE.words.text}. (protocol/README.md, “The worker's half”) "
        f"expected exit code 2 got exit code 0 next {MENDS[Rule.REFUSE]}"
    )
    assert explanation(again, [passed, failed]) == ["           as in: breaks"]
    assert len(explanation(again, [replace(failed, got="exit code 1")])) >= 4
    longer = [replace(each, got=f"ticket {ticket}") for each, ticket in ((failed, 1234), (again, 4321))]
    assert explanation(longer[1], longer[:1]) == ["           as in: breaks"]
    assert summary(test.results).endswith("the client does not conform")
    data = as_data(test.results, "environment", ["client"])
    assert data["conforms"] is False
    assert [each["rule"] for each in data["checks"]] == ["", Rule.REFUSE.words.text, Rule.REFUSE.words.text, ""]


def test_whoever_breaks_a_rule_that_a_check_knows_is_told_what_to_do_next() -> None:
    checks = [source for source in Path(mends.__file__).parent.glob("*.py") if source.name != "mends.py"]
    named = {name for source in checks for name in re.findall(r"\bRule\.([A-Z_]+)", source.read_text(encoding="utf-8"))}
    assert named == {rule.name for rule in MENDS}
    assert len(named) > 80


def test_no_two_checks_of_a_profile_have_one_name() -> None:
    for checks in PROFILES.values():
        names = [check.name for check in checks]
        assert len(names) == len(set(names)) >= 40


@pytest.mark.parametrize(
    ("changed", "rule", "got"),
    [
        ({"reward": np.zeros(2, np.float32)}, Rule.STEPPED_ARRAYS, "reward: expected float64[2], got float32[2]"),
        ({"obs": (np.array([0, 2], np.int8),)}, Rule.IN_SPACE, "observation: expected 0 to 1, got 2 at copy 1"),
        ({"reward": np.array([np.nan, 0.0])}, Rule.IN_SPACE, "reward: expected finite values, got nan at copy 0"),
    ],
)
def test_results_of_a_step_have_the_arrays_of_their_lane_and_values_of_their_spaces(
    changed: dict[str, Any], rule: Rule, got: str
) -> None:
    check_stepped(STEPPED_ANSWER, STEPPED)
    with pytest.raises(Broken) as broken:
        check_stepped(msgspec.structs.replace(STEPPED_ANSWER, **changed), STEPPED)
    assert broken.value.rule is rule
    assert got in broken.value.got
