"""Each sentence that says who waits for whom, and when nothing is said. Pure."""

from __future__ import annotations

from dataclasses import replace

import pytest

from millrace.learner.members.held_up import LONG_S
from millrace.learner.members.member import Member
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.learner.rollouts.waiting import SHARES_AFTER_S, LearnerTime, Phase
from millrace.protocol.alive import Alive, WorkerActivity
from millrace.protocol.call_timeouts import Doing
from millrace.protocol.messages import Evaluated, Goodbye, Heartbeat
from millrace.protocol.random_streams import Purpose
from millrace.protocol.rollout import Episode
from tests.learner.rollouts.test_ticket_coordinator import Learner
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS
from tests.support.conversation.rules import pending_evaluation
from tests.support.in_process.fake_processes import FakeProcesses

A, B = b"a", b"b"
NO_WORKER = "a worker to join at tcp://box:5555 (the last one was killed by SIGKILL)"


class Run:
    """A learner and its time, with workers of which a supervisor tells."""

    def __init__(self, lanes: int = 2, max_lag: int = 0, workers: tuple[bytes, ...] = (A,), rollout_steps: int = 1) -> None:
        self.learner = Learner(lanes, max_lag=max_lag, publish=False, rollout_steps=rollout_steps)
        for peer in workers:
            self.learner.joins(peer, host=f"host-of-{peer.decode()}")
        self.learner.publish(0)
        self.stepping: list[Member] = []
        self.time = LearnerTime(
            self.learner.coordinator, self.learner.now, lambda: NO_WORKER, FakeProcesses(of_stepping=lambda: self.stepping)
        )

    def turn(self, phase: Phase, after_s: float = 0.0) -> None:
        self.learner.now += after_s
        self.time.turn(phase, self.learner.now)

    def does(self, peer: bytes, doing: Doing, for_s: float = 0.0) -> None:
        hello = self.learner.coordinator.members[peer].hello
        said = WorkerActivity(hello.worker, hello.process_nonce, doing, for_s, 0)
        self.learner.says(b"supervisor", Alive((said,), ()))

    def steps(self, peer: bytes, per_s: float) -> None:
        """Two heartbeats, a second apart."""
        session, before = self.learner.session(peer), self.learner.coordinator.members[peer].heartbeat
        steps = 0 if before is None else before.steps
        for more in (0, per_s):
            self.learner.now += 1.0
            held = tuple(self.learner.tickets(peer))
            self.learner.says(
                peer, example(Heartbeat, session=session, versions=(0,), tickets=held, steps=steps + int(more))
            )

    @property
    def line(self) -> str:
        return self.time.line(self.learner.now)


def test_a_call_that_lasts_is_named_with_its_lanes_worker_and_host() -> None:
    run = Run(lanes=2, workers=(A, B))
    run.turn("gathering")
    run.learner.now += 12.0
    run.does(A, "stepping", 0.1)
    run.does(B, "resetting", 11.4)
    assert run.line == "waiting 12 s for lane 1 (worker b on host-of-b: in reset for 11 s) and 1 more"
    (ticket,) = run.learner.tickets(A)
    run.learner.delivers(ticket)
    awaited = "waiting 12 s for lane 1 (worker b on host-of-b: in reset for 11 s)"
    assert run.line == f"{awaited}; first rollouts: 1 of 2 env steps"


def test_a_wait_is_said_when_it_lasts() -> None:
    run = Run()
    run.turn("gathering")
    run.learner.now += LONG_S - 0.1
    assert run.line == ""
    run.learner.now += 0.1
    assert run.line.startswith("waiting 2 s for lanes 0, 1 (worker a")


def test_many_lanes_of_one_worker_are_cut_after_four() -> None:
    run = Run(lanes=6)
    run.turn("gathering")
    run.learner.now += 5.0
    run.does(A, "making", 4.0)
    assert run.line == "waiting 5 s for lanes 0, 1, 2, 3, … (worker a on host-of-a: in construction for 4 s)"


def test_of_workers_that_make_short_steps_the_slowest_is_named_with_its_speed() -> None:
    run = Run(workers=(A, B))
    run.turn("gathering")
    run.steps(A, 400)
    run.steps(B, 3)
    run.does(A, "stepping", 0.4)
    run.does(B, "stepping", 0.3)
    assert run.line.startswith("waiting 4 s for lane 1 (worker b on host-of-b: 3.0 steps/s) and 1 more;")


def test_with_a_slow_environment_it_says_how_much_of_the_first_rollouts_is_made_and_how_long_the_rest_takes() -> None:
    run = Run(lanes=2, workers=(A, B), rollout_steps=64)
    run.turn("gathering")
    run.steps(A, 8)
    assert run.line.endswith("; first rollouts: 8 of 128 env steps, about 15 s left"), "120 steps at 8 a second"
    run.steps(B, 4)
    assert run.line.endswith("; first rollouts: 12 of 128 env steps, about 14 s left"), "116 at 4 and at 4: a is silent"
    run.learner.says(B, Goodbye(run.learner.session(B), "told to stop", ()))
    assert "; first rollouts: 8 of 128 env steps" in run.line, "what b has made is lost"


def test_env_steps_of_a_rollout_that_has_come_and_of_an_evaluation_are_not_counted_again() -> None:
    run = Run(lanes=1)
    run.learner.coordinator.begin_evaluation(EvaluationPlan.of(1, 0, 1, 10))
    run.steps(A, 1)  # of the rollout, which came first
    coordinator = run.learner.coordinator
    assert coordinator.collected() == 1
    run.learner.delivers(0)
    assert coordinator.collected() == 1
    run.learner.take()
    (ticket,) = pending_evaluation(coordinator).playing
    episode = Episode(1.0, 5, 0.0)
    run.learner.says(A, example(Evaluated, session=run.learner.session(A), ticket=ticket, episodes=(episode,), cut=(False,)))
    coordinator.evaluation.end()
    run.learner.publish(1)
    run.steps(A, 5)  # in all 6: the rollout and the evaluation
    assert coordinator.collected() == 0
    run.steps(A, 1)
    assert coordinator.collected() == 1
    run.turn("gathering")
    run.learner.now += 3.0
    assert run.line.endswith("; next rollouts: 1 of 1 env steps")


def test_env_steps_from_before_a_session_are_not_counted_in_it() -> None:
    run = Run(lanes=1, rollout_steps=64)
    run.steps(A, 20)
    run.learner.joins(A, host="host-of-a", attempt=2)
    assert run.learner.coordinator.collected() == 0
    session, held = run.learner.session(A), tuple(run.learner.tickets(A))
    for steps, collected in ((20, 0), (23, 3)):
        run.learner.says(A, example(Heartbeat, session=session, versions=(0,), tickets=held, steps=steps))
        assert run.learner.coordinator.collected() == collected


def test_a_process_that_is_stopped_is_silent_whatever_it_did_before() -> None:
    run = Run()
    run.turn("gathering")
    run.does(A, "stepping", 0.1)
    run.learner.now += 4.0
    assert run.line == "waiting 4 s for lanes 0, 1 (worker a on host-of-a: silent for 4 s)"


def test_without_a_worker_it_says_what_is_known_of_the_last_one() -> None:
    run = Run()
    run.turn("gathering")
    run.learner.says(A, Goodbye(run.learner.session(A), "told to stop", ()))
    run.learner.now += 3.0
    assert run.line == f"waiting 3 s for {NO_WORKER}"
    run.turn("starting")
    run.learner.now += 3.0
    assert run.line == f"waiting 3 s for {NO_WORKER}"


@pytest.mark.parametrize(
    ("doing", "said"),
    [
        ("stepping", "in step for 38 s, at most 600 s (--step-timeout-s)"),
        ("resetting", "in reset for 38 s, at most 600 s (--start-timeout-s)"),
    ],
)
def test_of_a_call_that_may_hang_it_is_said_when_it_is_ended(doing: Doing, said: str) -> None:
    run = Run(lanes=1)
    run.turn("gathering")
    run.learner.now += 40.0
    run.does(A, doing, 38.0)
    assert run.line.startswith(f"waiting 40 s for lane 0 (worker a on host-of-a: {said})")


def test_with_a_lag_every_lane_that_may_bring_the_next_rollout_counts_once() -> None:
    run = Run(lanes=2, max_lag=1, workers=(A, B))
    assert len(run.learner.tickets()) == 4
    run.turn("gathering")
    run.learner.now += 3.0
    run.does(A, "stepping", 2.6)
    run.does(B, "stepping", 0.1)
    assert run.line == "waiting 3 s for lane 0 (worker a on host-of-a: in step for 3 s) and 1 more"
    run.learner.delivers(run.learner.tickets(A)[0])  # the rollout of the next update; that of the one after is outstanding
    awaited = "waiting 3 s for lane 1 (worker b on host-of-b: no env step yet)"
    assert run.line == f"{awaited}; first rollouts: 1 of 2 env steps"


@pytest.mark.parametrize(("max_lag", "idle"), [(0, ", 1 of 1 workers waiting for weights"), (1, "")])
def test_while_it_learns_only_workers_without_a_ticket_wait(max_lag: int, idle: str) -> None:
    run = Run(max_lag=max_lag)
    run.learner.deliver_round()
    run.learner.take()
    run.turn("learning")
    assert run.line == ""
    run.learner.now += 40.0
    learning = f"learning for 40 s{idle}; so far 0% waiting for rollouts, 100% learning"
    assert run.line == learning
    run.time.learned(run.learner.now)
    run.learner.publish(1)
    assert run.line == learning, "it tells of what was before the weights were sent"
    run.turn("gathering")
    run.turn("learning", after_s=0.5)
    assert run.line == ""


def test_a_spare_worker_waits_for_a_lane_and_not_for_weights() -> None:
    run = Run(lanes=1, workers=(A, B))
    run.learner.deliver_all()
    run.turn("learning")
    run.learner.now += 3.0
    assert run.line == "learning for 3 s, 1 of 2 workers waiting for weights"


def test_between_two_long_waits_it_tells_of_the_last_one() -> None:
    run = Run()
    run.turn("gathering")
    run.turn("learning", after_s=12.0)
    assert run.line == "waited 12 s for rollouts"
    run.turn("gathering", after_s=0.5)
    run.learner.now += 1.0
    assert run.line == "waited 12 s for rollouts"
    run.turn("learning", after_s=5.5)
    assert run.line == "waited 6 s for rollouts"
    run.turn("gathering")
    run.turn("learning", after_s=0.5)
    assert run.line == "", "the last wait was short"


def test_the_shares_are_those_of_training() -> None:
    run = Run()
    run.turn("gathering", after_s=1_000.0)
    run.turn("learning", after_s=15.0)
    run.turn("evaluating", after_s=SHARES_AFTER_S - 18.1)
    run.turn("gathering", after_s=1_000.0)
    run.learner.now += 3.0
    assert "so far" not in run.line
    run.learner.now += 0.2
    assert run.line.endswith("; so far 60% waiting for rollouts, 40% learning")


@pytest.mark.parametrize(
    ("purpose", "what", "time_limit", "longest"),
    [
        (Purpose.EVALUATION, "", None, 500),
        (Purpose.EVALUATION, "", 50, 50),
        (Purpose.EVALUATION, "", 1_000, 500),
        (Purpose.CONFIRMATION, " the best policy", None, 500),
    ],
)
def test_an_evaluation_says_how_far_it_is_and_who_is_held_up(
    purpose: Purpose, what: str, time_limit: int | None, longest: int
) -> None:
    run = Run(workers=(A, B))
    run.learner.deliver_all()
    run.learner.take()
    run.learner.coordinator.publish(1, PARAMETERS, BUFFERS)
    run.turn("evaluating")
    plan = replace(EvaluationPlan.of(10, seed=1, copies=2, max_steps=5_000, purpose=purpose), time_limit=time_limit)
    run.learner.balanced(run.learner.coordinator.begin_evaluation(plan))
    run.learner.now += 41.0
    run.does(A, "evaluating", 0.1)
    run.does(B, "evaluating", 11.0)
    done = f"0 of 10 episodes (at most {longest} env steps each)"
    assert run.line == f"evaluating{what} for 41 s: {done}; worker b on host-of-b: in evaluation for 11 s"
    for peer in (A, B):
        run.learner.says(peer, Goodbye(run.learner.session(peer), "told to stop", ()))
    assert run.line == f"waiting 41 s for {NO_WORKER}"


def test_if_the_members_only_act_the_worker_that_steps_is_named() -> None:
    acting, stepping = Run(), Run(workers=(A, B))
    acting.turn("gathering")
    acting.learner.now += 5.0
    stepping.learner.now = acting.learner.now
    for peer in (A, B):
        stepping.learner.says(peer, example(Heartbeat, session=stepping.learner.session(peer)))
    stepping.does(B, "resetting", 4.0)
    acting.stepping = list(stepping.learner.coordinator.members.values())
    assert acting.line == "waiting 5 s for lanes 0, 1 (worker b on host-of-b: in reset for 4 s)"
