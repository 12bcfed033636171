"""What a supervisor says of its workers: when it is believed, and what follows. And when a run stands still. Pure."""

from __future__ import annotations

import math
from collections import Counter
from typing import cast, get_args

import pytest

from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.members.events import Failed, PolicyRaised, WorkerLeft, WorkerProcessFailed
from millrace.learner.members.lobby import Lobby
from millrace.learner.open_hub import lobby_settings, open_hub
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.learner.rollouts.stall_watch import ENDED_WITHIN_S, StallWatch, Standstill
from millrace.protocol.alive import Alive, WorkerActivity, WorkerExit
from millrace.protocol.call_timeouts import OUR_CODE, CallTimeouts, Doing
from millrace.protocol.messages import Drain, Heartbeat, Hello
from millrace.protocol.wire.learner_link import LearnerLink
from tests.learner.rollouts.test_ticket_coordinator import TIMEOUT_S, Learner, permits
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, run_spec, spoiled
from tests.support.conversation.fake_link import FakeLink
from tests.support.in_process.fake_processes import FakeProcesses

A, B, SUPERVISOR = b"a", b"b", b"supervisor-of-a"
NONCE = 1000 * len("host") + 1  # as `Learner.joins` makes it


def activity(doing: Doing = "stepping", for_s: float = 0.0, calls: int = 0, nonce: int = NONCE) -> WorkerActivity:
    return WorkerActivity("a", nonce, doing, for_s, calls)


def speaks(learner: Learner, said: WorkerActivity, peer: bytes = SUPERVISOR) -> None:
    learner.says(peer, Alive((said,), ()))


def is_member_after(learner: Learner, seconds: float) -> bool:
    learner.now += seconds
    learner.coordinator.remove_silent(learner.now)
    return A in learner.coordinator.members


@pytest.mark.parametrize("doing", sorted(set(get_args(Doing)) - OUR_CODE))
def test_a_worker_in_the_users_code_is_not_silent(doing: Doing) -> None:
    learner = Learner()
    learner.joins(A)
    for _ in range(5):
        learner.now += TIMEOUT_S - 0.5
        speaks(learner, activity(doing))
        assert is_member_after(learner, 0.4)


@pytest.mark.parametrize(
    "said",
    [
        *(activity(doing) for doing in ("starting", "waiting")),  # a worker in our own code must speak for itself
        *(activity(nonce=NONCE + 1), WorkerActivity("b", NONCE, "stepping", 0.0, 0)),  # who does not know the nonce
    ],
)
def test_what_is_said_for_a_silent_worker_and_does_not_count(said: WorkerActivity) -> None:
    learner = Learner()
    learner.joins(A)
    learner.now += TIMEOUT_S - 0.5
    speaks(learner, said)
    assert not is_member_after(learner, 0.6)


def test_a_worker_whose_long_step_has_just_ended_has_its_timeout_to_speak() -> None:
    learner = Learner()
    learner.joins(A)
    learner.now += 3 * TIMEOUT_S
    speaks(learner, activity("stepping", 3 * TIMEOUT_S))
    learner.now += 0.5
    speaks(learner, activity("waiting"))
    assert is_member_after(learner, TIMEOUT_S - 0.6)
    assert not is_member_after(learner, 0.2)


def test_a_supervisor_that_falls_silent_speaks_for_nobody() -> None:
    learner = Learner()
    learner.joins(A)
    speaks(learner, activity())
    assert is_member_after(learner, TIMEOUT_S - 0.1)
    assert not is_member_after(learner, 0.2)


@pytest.mark.parametrize(("key", "believed"), [(b"aa", True), (b"bb", False), (b"", False)])
def test_who_uses_another_key_is_not_believed(key: bytes, believed: bool) -> None:
    """With keys, a peer is its routing id and its key."""
    learner = Learner()
    peer = b"a\0tag\0aa"
    learner.says(peer, example(Hello, worker="a", process_nonce=NONCE))
    speaker = b"supervisor\0tag\0" + key if key else SUPERVISOR
    learner.now += TIMEOUT_S - 0.5
    speaks(learner, activity(), speaker)
    learner.says(speaker, Alive((), (WorkerExit("a", NONCE + 1, "was killed", True),)))
    learner.now += 0.6
    learner.coordinator.remove_silent(learner.now)
    assert (peer in learner.coordinator.members) == believed
    if believed:
        learner.says(b"x\0tag\0bb", Alive((), (WorkerExit("a", NONCE, "was killed", True),)))
        assert peer in learner.coordinator.members, "another key ended a worker"


def test_an_exit_is_counted_once_and_its_tickets_are_dealt_again() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.joins(B, host="other")
    held = len(learner.tickets(A))
    learner.coordinator.membership.take_events()
    said = Alive((), (WorkerExit("a", NONCE, "ended with exit code 0 in a step of its environment", True),))
    outs = learner.says(SUPERVISOR, said)
    assert len(permits(outs, B)) == held > 0
    assert learner.says(SUPERVISOR, said) == []
    why = "ended with exit code 0 in a step of its environment"
    assert learner.coordinator.membership.take_events() == [
        WorkerProcessFailed("a", "host", f"its process {why}", lanes=(0, 1)),
        WorkerLeft("a", why, held, False),
    ]


@pytest.mark.parametrize(("code", "kind"), [(("mine:rock",), PolicyRaised), ((), WorkerProcessFailed)])
def test_a_process_that_ended_in_a_call_of_the_users_policy_is_the_policys_failure(
    code: tuple[str, ...], kind: type[Failed]
) -> None:
    """No worker can blame a policy that is not the user's."""
    learner = Learner(lanes=1, scripted=code)
    learner.joins(A)
    learner.coordinator.membership.take_events()
    why = "was ended: a call of the policy took longer than 3 s (--step-timeout-s), at mine.py:7, in act"
    learner.says(SUPERVISOR, Alive((), (WorkerExit("a", NONCE, why, failed=True, of_policy=True),)))
    failed, _ = learner.coordinator.membership.take_events()
    assert failed == kind("a", "host", f"its process {why}", lanes=(0,))


def test_an_exit_on_purpose_and_that_of_a_spare_count_as_no_failure() -> None:
    learner = Learner(lanes=1)
    learner.joins(A)
    learner.joins(B, host="other")
    learner.coordinator.begin_evaluation(EvaluationPlan(seeds=(1, 2), copies=1, most_steps=10))
    assert learner.coordinator.members[B].tickets  # of the evaluation; the learner can do without it
    learner.coordinator.membership.take_events()
    learner.says(SUPERVISOR, Alive((), (WorkerExit("b", 1000 * len("other") + 1, "was killed", True),)))
    (failed, _) = learner.coordinator.membership.take_events()
    assert isinstance(failed, WorkerProcessFailed)
    assert failed.spare
    learner.says(SUPERVISOR, Alive((), (WorkerExit("a", NONCE, "ended with exit code 1", False),)))
    assert learner.coordinator.membership.take_events() == [WorkerLeft("a", "ended with exit code 1", 2, False)]


def test_a_supervisor_learns_that_the_run_is_over() -> None:
    learner = Learner()
    learner.joins(A)
    assert learner.says(SUPERVISOR, Alive((activity(),), ())) == []
    learner.coordinator.drain("all steps done")
    assert learner.says(SUPERVISOR, Alive((activity(),), ())) == [(SUPERVISOR, Drain("all steps done"))]


def test_status_says_what_a_worker_does_until_its_supervisor_is_silent() -> None:
    learner = Learner()
    learner.joins(A)
    speaks(learner, activity("resetting", 40.0))
    (row,) = learner.coordinator.membership.status(learner.now + 1.5)
    assert (row.doing, row.doing_s) == ("resetting", 41.5)
    assert row.silent_s == 1.5
    learner.now += 2.0
    speaks(learner, activity("resetting", 42.0))
    (row,) = learner.coordinator.membership.status(learner.now)
    assert row.silent_s == 2.0, "the worker itself says nothing"
    (row,) = learner.coordinator.membership.status(learner.now + 60.0)
    assert (row.doing, row.doing_s) == ("", 0.0)


# ---------------------------------------------------------------- standing still

STALL_S, STEP_S = 100.0, 30.0
TIMEOUTS = CallTimeouts(STEP_S, STEP_S)


def watch(learner: Learner, timeouts: CallTimeouts = TIMEOUTS) -> StallWatch:
    made = StallWatch(learner.coordinator, STALL_S, timeouts)
    made.begin(learner.now)
    assert made.check(learner.now, 0) is None
    return made


def beats(learner: Learner, peer: bytes, steps: int) -> None:
    held = tuple(learner.tickets(peer))
    learner.says(peer, example(Heartbeat, session=learner.session(peer), versions=(0,), tickets=held, steps=steps))


def test_a_run_in_which_nothing_happens_stands_still() -> None:
    learner = Learner()
    learner.joins(A)
    made = watch(learner)
    assert made.check(learner.now + STALL_S, 0) is None
    verdict = made.check(learner.now + STALL_S + 1, 0)
    assert isinstance(verdict, Standstill)
    assert verdict.refuse == ()


def test_time_in_which_the_learner_did_not_wait_is_no_standstill() -> None:
    learner = Learner()
    learner.joins(A)
    made = watch(learner, CallTimeouts(0.0, 0.0))
    learner.now += 10 * STALL_S
    made.begin(learner.now)
    assert made.check(learner.now + STALL_S, 0) is None


def test_env_steps_calls_and_rollouts_are_progress() -> None:
    learner = Learner()
    learner.joins(A)
    made, arrived = watch(learner, CallTimeouts(0.0, 0.0)), 0
    for number, kind in enumerate(["steps", "steps", "calls", "calls", "rollouts", "rollouts"], 1):
        learner.now += STALL_S - 1
        if kind == "steps":
            beats(learner, A, number)
        elif kind == "calls":
            speaks(learner, activity("waiting", calls=number))
        else:
            arrived += 1
        assert made.check(learner.now, arrived) is None


@pytest.mark.parametrize(("calls", "progress"), [(0, 0), (1, 1)])
def test_the_first_call_that_has_returned_is_progress_although_nothing_was_said_before(calls: int, progress: int) -> None:
    learner = Learner()
    learner.joins(A)
    before = learner.coordinator.membership.progress[False]
    speaks(learner, activity("waiting", calls=calls))
    assert learner.coordinator.membership.progress[False] - before == progress


def test_a_call_within_its_timeout_is_no_standstill_and_one_beyond_it_is() -> None:
    learner = Learner()
    learner.joins(A)
    made = watch(learner)
    learner.now += STALL_S + 1
    speaks(learner, activity("stepping", STEP_S + ENDED_WITHIN_S - 1))
    assert made.check(learner.now, 0) is None
    assert made.check(learner.now + 2, 0) is not None, "the call has lasted since its supervisor spoke"
    learner.now += STALL_S + 3
    speaks(learner, activity("stepping", STEP_S + ENDED_WITHIN_S + 1))
    assert made.check(learner.now, 0) is not None


def test_a_call_of_which_its_supervisor_speaks_no_more_is_a_standstill() -> None:
    learner = Learner()
    learner.joins(A)
    made = watch(learner, CallTimeouts(10 * STALL_S, 10 * STALL_S))
    speaks(learner, activity())
    assert made.check(learner.now + STALL_S + 1, 0) is not None


def test_a_worker_that_hoards_its_tickets_is_refused_and_another_gets_them() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    learner.joins(B, host="other")
    made = watch(learner, CallTimeouts(0.0, 0.0))
    hoarded = len(learner.tickets(A))
    for _ in range(2):
        learner.now += STALL_S / 2 + 1
        beats(learner, A, 0)
    verdict = made.check(learner.now, 0)
    assert isinstance(verdict, Standstill)
    (member,) = verdict.refuse
    assert member.peer == A
    outs = learner.balanced(learner.coordinator.refuse(member, verdict.why))
    assert len(permits(outs, B)) == hoarded == 2
    assert made.check(learner.now + STALL_S / 2, 0) is None, "the other worker has no time to begin"


def test_a_worker_that_claims_progress_is_refused_when_its_budget_is_spent() -> None:
    learner = Learner()
    learner.joins(A)
    made = watch(learner)
    run = learner.coordinator.run
    each_s = run.copies * (2 * STEP_S + run.rollout_steps * STEP_S)
    budget_s, steps = each_s * len(learner.tickets(A)), 0
    while (verdict := made.check(learner.now, 0)) is None:
        learner.now += STALL_S / 2
        steps += 1
        beats(learner, A, steps)
        assert learner.now < budget_s + STALL_S
    assert learner.now > budget_s
    assert isinstance(verdict, Standstill)
    assert [member.peer for member in verdict.refuse] == [A]


def test_the_oldest_ticket_of_a_worker_counts() -> None:
    learner = Learner(lanes=2)
    learner.joins(A)
    made, run = watch(learner), learner.coordinator.run
    learner.now += 2 * run.copies * (2 * STEP_S + run.rollout_steps * STEP_S) - 1
    assert made.check(learner.now, "progress") is None
    learner.says(A, spoiled(learner.rollout_of(1)))  # the other lane's; dealt again
    assert made.check(learner.now, "more progress") is None
    assert made.check(learner.now + 2, "still more") is not None


def test_each_step_may_be_a_reset_that_takes_longer() -> None:
    learner = Learner()
    learner.joins(A)
    assert watch(learner, CallTimeouts(10 * STEP_S, STEP_S))._longest_s(copies=1, steps=7) > 7 * 10 * STEP_S


def test_each_step_may_have_a_call_of_the_policy_and_of_an_opponent() -> None:
    learner = Learner(scripted=("mine:rock",))
    learner.joins(A)
    steps = 7
    assert watch(learner, TIMEOUTS)._longest_s(copies=2, steps=steps) > 2 * steps * 3 * STEP_S


def test_without_timeouts_there_is_no_budget() -> None:
    learner = Learner()
    learner.joins(A)
    made = watch(learner, CallTimeouts(0.0, 0.0))
    assert made._longest_s(copies=1, steps=1) == math.inf


def about_to_evaluate() -> Learner:
    """A learner after its first update, with two workers on two hosts; no ticket is dealt."""
    learner = Learner()
    learner.joins(A)
    learner.deliver_all()
    assert learner.coordinator.rollouts.take() is not None
    learner.coordinator.publish(1, PARAMETERS, BUFFERS)
    learner.joins(B, host="other")
    return learner


def test_a_worker_that_sits_on_an_evaluation_is_refused_when_its_budget_is_spent() -> None:
    learner = about_to_evaluate()
    plan = EvaluationPlan(seeds=(1, 2, 3, 4), copies=2, most_steps=10)
    learner.balanced(learner.coordinator.begin_evaluation(plan))
    made, steps = watch(learner), 0
    budget_s = plan.copies * (2 * STEP_S + plan.most_steps * STEP_S)
    while (verdict := made.check(learner.now, steps)) is None:
        learner.now += STALL_S / 4
        steps += 1
        beats(learner, A, steps)
        beats(learner, B, steps)
        assert learner.now < budget_s + STALL_S
    assert learner.now > budget_s
    assert isinstance(verdict, Standstill)
    assert {member.peer for member in verdict.refuse} == {A, B}
    learner.coordinator.evaluation.end()
    assert made.check(learner.now + 2, steps + 1) is None, "an evaluation that has ended holds nobody to account"


@pytest.mark.parametrize(("tickets", "shares"), [(7, (2, 2)), (5, (2, 1)), (4, (1, 1)), (3, (1, 1))])
def test_a_worker_holds_a_second_ticket_of_an_evaluation_only_while_there_are_plenty_and_never_a_third(
    tickets: int, shares: tuple[int, int]
) -> None:
    """Every Heartbeat deals, so it must not give one more to a worker that has its share."""
    learner = about_to_evaluate()
    plan = EvaluationPlan(seeds=tuple(range(tickets)), copies=1, most_steps=10)
    learner.balanced(learner.coordinator.begin_evaluation(plan))
    dealt = {number: list(members) for number, members in learner.evaluation.playing.items()}
    assert Counter(member.peer for (member,) in dealt.values()) == {A: shares[0], B: shares[1]}
    for peer in (A, B, A, B):
        learner.beats(peer)
        assert learner.evaluation.playing == dealt


@pytest.mark.parametrize(("most", "evaluators"), [(0, {A, B}), (5, {A, B}), (4, {A}), (1, {A})])
def test_with_a_limit_of_copies_as_few_workers_play_evaluations_as_it_allows(most: int, evaluators: set[bytes]) -> None:
    learner = about_to_evaluate()
    learner.coordinator.evaluation.most_copies = most - 1 if most else None
    learner.balanced(learner.coordinator.begin_evaluation(EvaluationPlan(seeds=(1, 2, 3, 4), copies=2, most_steps=10)))
    assert {member.peer for member in learner.evaluation.players} == evaluators


@pytest.mark.parametrize(("of_run", "of_machine", "least"), [(0, 0, 0), (9, 0, 9), (0, 7, 7), (9, 7, 7), (7, 9, 7)])
def test_a_run_keeps_within_its_own_limit_of_copies_and_its_machine_s(of_run: int, of_machine: int, least: int) -> None:
    config, processes = RolloutConfig(max_env_copies=of_run), FakeProcesses(most_copies=of_machine)
    lobby = Lobby(cast(LearnerLink, FakeLink()), processes, lobby_settings(config))
    hub = open_hub(config, run_spec(), lobby, lambda: None)
    assert hub.coordinator.evaluation.most_copies == (least - 4 if least else None)
