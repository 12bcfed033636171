"""Evaluations beside training: who plays them, under which weights, and what happens when nobody is left who does. Pure."""

from __future__ import annotations

import pytest

from millrace.learner.members.events import WorkerProcessFailed
from millrace.learner.members.failure_count import FailureCount
from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.stall_watch import Overdue, StallWatch, Standstill
from millrace.protocol.bounds import Stages
from millrace.protocol.call_timeouts import CallTimeouts
from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.messages import Collect, Evaluate, Heartbeat, Hello, Weights, WorkerExit
from tests.learner.rollouts.test_evaluation_dealer import answer, orders, plan
from tests.learner.rollouts.test_ticket_coordinator import Learner, of, permits
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, process_ends

A, B, E, F = b"a", b"b", b"e", b"f"


class BesideLearner(Learner):
    """A learner with workers that only evaluate, and shorthand for evaluations beside training."""

    def evaluator_joins(self, peer: bytes) -> list[Outgoing]:
        return self.says(peer, example(Hello, worker=peer.decode(), process_nonce=77, attempt=78, evaluates=True))

    def begins(self, *seeds: int) -> list[Outgoing]:
        return self.balanced(self.coordinator.begin_evaluation(plan(*seeds), beside=True))

    def awaits(self) -> list[Outgoing]:
        return self.balanced(self.coordinator.await_evaluation())

    def ends(self, peer: bytes) -> list[Outgoing]:
        return self.balanced(process_ends(self.coordinator, peer.decode(), "killed"))


def learner_with(*peers: bytes, lanes: int = 1, max_lag: int = 0) -> BesideLearner:
    learner = BesideLearner(lanes, max_lag)
    for peer in peers:
        if peer in (E, F):
            learner.evaluator_joins(peer)
        else:
            learner.joins(peer)
    return learner


@pytest.mark.parametrize("peers", [(E, A, B), (A, E, B), (A, B, E)])
def test_a_worker_that_only_evaluates_gets_no_lane(peers: tuple[bytes, ...]) -> None:
    learner = learner_with(*peers, lanes=4)
    for _ in range(3):
        learner.update()
    owned = {peer: len(member.lanes) for peer, member in learner.coordinator.members.items()}
    assert owned == {A: 2, B: 2, E: 0}
    for peer in (A, B):
        learner.ends(peer)
    assert learner.coordinator.members[E].lanes == set()
    assert learner.tickets() == []
    assert len(permits(learner.joins(A))) == 4


def test_they_play_it_while_the_others_collect() -> None:
    learner = learner_with(A, E, F)
    outs = learner.begins(1, 2, 3, 4, 5)
    assert [(peer, message.seeds) for peer, message in outs if isinstance(message, Evaluate)] == [(E, (1, 2)), (F, (3, 4))]
    (number,) = learner.tickets(A)
    learner.delivers(number)
    learner.take()
    assert len(permits(learner.publish(1), A)) == 1


def test_only_those_who_collect_wait_for_training() -> None:
    learner = learner_with(A, E)
    learner.now = 60.0
    for peer in (A, E):
        spent: Stages = {"wait": 20.0, "evaluate": 10.0}
        learner.says(
            peer,
            example(
                Heartbeat, session=learner.session(peer), versions=(0,), tickets=tuple(learner.tickets(peer)), stages=spent
            ),
        )
    assert learner.coordinator.membership.stages() == {"wait": 20.0, "evaluate": 20.0}


def test_a_lost_ticket_is_played_under_the_version_that_is_evaluated() -> None:
    """Although newer weights were published, and the worker that gets the ticket has joined since."""
    learner = learner_with(A, E)
    learner.begins(1, 2)
    for _ in range(2):
        learner.update()
    learner.ends(E)
    outs = learner.evaluator_joins(F)
    assert [order.version for order in of(outs, Evaluate, F)] == [0]
    assert [weights.version for weights in of(outs, Weights, F)] == [0]


def test_while_one_of_them_lives_the_learner_waits() -> None:
    learner = learner_with(A, E)
    learner.begins(1, 2, 3)
    assert learner.awaits() == []
    assert learner.evaluation.beside


@pytest.mark.parametrize("ever", [True, False])
def test_without_one_all_play_it_and_none_collects(ever: bool) -> None:
    learner = learner_with(A, B, *([E] if ever else []))
    learner.begins(1, 2, 3)
    learner.update()
    if ever:
        assert of(learner.ends(E), Evaluate) == [], "it waits until the learner does"
    learner.deliver_all()
    learner.take()
    learner.coordinator.publish(2, PARAMETERS, BUFFERS)
    outs = learner.awaits()
    assert {(peer, order.version) for peer, order in outs if isinstance(order, Evaluate)} == {(A, 0), (B, 0)}
    assert of(outs, Collect) == []
    for order in orders(outs):
        peer = next(peer for peer, message in outs if message is order)
        learner.says(peer, answer(order))
    assert [one.episode.length for one in learner.coordinator.evaluation.end()] == [1, 2, 3]
    assert len(permits(learner.coordinator.begin_update())) == 1


def test_weights_are_sent_again_to_a_worker_that_has_dropped_them() -> None:
    """It keeps the newest, and those that its tickets name. So no Heartbeat has to show that it lacks older ones."""
    learner = learner_with(A, E)
    learner.begins(1, 2)
    learner.update()
    assert [weights.version for weights in of(learner.ends(E), Weights)] == []
    assert [weights.version for weights in of(learner.awaits(), Weights, A)] == [0]
    assert learner.holds(A) == {0, 1}


def test_with_a_limit_of_copies_one_other_worker_plays() -> None:
    learner = learner_with(A, B)
    learner.coordinator.evaluation.most_copies = 4
    learner.begins(1, 2, 3, 4)
    assert len(orders(learner.awaits())) == 1


def test_when_all_play_those_that_only_evaluate_are_first() -> None:
    learner = learner_with(A, E)
    learner.coordinator.evaluation.most_copies = 2
    assert [peer for peer, _ in learner.coordinator.begin_evaluation(plan(1, 2, 3, 4))] == [E, E]


@pytest.mark.parametrize("evaluating", [False, True])
def test_their_env_steps_are_progress_only_while_the_learner_waits_for_an_evaluation(evaluating: bool) -> None:
    learner = learner_with(A, E)
    learner.begins(1, 2)
    watch = StallWatch(learner.coordinator, 100.0, CallTimeouts(0.0, 0.0))
    watch.begin(learner.now)
    assert watch.check(learner.now, 0, evaluating=evaluating) is None
    learner.now += 60.0
    learner.says(E, example(Heartbeat, session=learner.session(E), versions=(0,), steps=9))
    assert watch.check(learner.now, 0, evaluating=evaluating) is None
    verdict = watch.check(learner.now + 39.0, 0, evaluating=evaluating)
    assert verdict is None
    verdict = watch.check(learner.now + 60.0, 0, evaluating=evaluating)
    assert isinstance(verdict, Overdue if evaluating else Standstill)
    assert not isinstance(verdict, Standstill) or verdict.refuse == (), "the only worker that collects stands still"


def test_claims_do_not_keep_an_evaluation_from_a_second_worker_and_only_an_answer_does() -> None:
    learner = learner_with(A, E)
    learner.begins(1, 2, 3, 4)
    watch, steps = StallWatch(learner.coordinator, 100.0, CallTimeouts(0.0, 0.0)), 0

    def verdicts(seconds: float) -> list[Standstill | Overdue]:
        nonlocal steps
        found = []
        for _ in range(int(seconds / 10.0)):
            learner.now += 10.0
            steps += 1
            learner.says(
                E,
                example(
                    Heartbeat,
                    session=learner.session(E),
                    versions=tuple(learner.coordinator.members[E].tickets),
                    steps=steps,
                ),
            )
            found.append(watch.check(learner.now, steps, evaluating=True))
        return [verdict for verdict in found if verdict is not None]

    watch.begin(learner.now)
    assert verdicts(100.0) == []
    assert verdicts(210.0) == [Overdue(), Overdue()], "once in the time, for one ticket each"
    (order,) = of(learner.coordinator.share_evaluation(), Evaluate, A)
    assert order.seeds == (1, 2), "one that collects plays the oldest"
    learner.says(A, answer(order))
    assert verdicts(100.0) == []
    assert verdicts(20.0) == [Overdue()]


def test_their_failures_count_and_only_their_own_episodes_end_their_row() -> None:
    learner = learner_with(A, E)
    learner.begins(1, 2)
    count = FailureCount(allowed=1)
    for success, ends in [("e", False), ("a", False), ("", True)]:
        learner.coordinator.membership.take_events()
        learner.balanced(learner.coordinator.process_ended(WorkerExit("e", 77, "was killed", True)))
        (failed, _) = learner.coordinator.membership.take_events()
        assert isinstance(failed, WorkerProcessFailed)
        assert not failed.spare
        count.count(failed, 0.0)
        if ends:
            with pytest.raises(EnvironmentFailed, match=r"worker e .*failure 2 in a row"):
                count.check()
        else:
            count.check()
        count.evaluated(success)
        learner.evaluator_joins(E)
