"""The tickets of an evaluation: what is asked for, who holds it, and what its answers make. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.evaluation_dealer import FIRST_TICKET, EvaluationPlan, OnRows, evaluation_of
from millrace.protocol.bounds import LARGEST
from millrace.protocol.messages import EpisodeRows, Evaluate, Evaluated
from millrace.protocol.rollout import Episode
from tests.learner.rollouts.test_ticket_coordinator import Learner, of, permits
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, fake_rollout, fake_rows, process_ends, spoiled

A, B = b"a", b"b"


def learner_with(*peers: bytes) -> Learner:
    learner = Learner(lanes=1)
    for peer in peers:
        learner.joins(peer, host=peer.decode())
    return learner


def plan(*seeds: int, copies: int = 2, send_rows: bool = False) -> EvaluationPlan:
    return EvaluationPlan(seeds, copies, most_steps=9, greedy=False, send_rows=send_rows, send_frames=send_rows)


def orders(outs: Sequence[Outgoing]) -> list[Evaluate]:
    return sorted(of(outs, Evaluate), key=lambda order: order.ticket)


def answer(order: Evaluate) -> Evaluated:
    """Each episode is as long as its seed says, and that of seed 1 was cut."""
    episodes = tuple(Episode(0.0, seed, 0.0) for seed in order.seeds if seed is not None)
    return example(
        Evaluated,
        session=order.session,
        ticket=order.ticket,
        episodes=episodes,
        cut=tuple(seed == 1 for seed in order.seeds),
    )


@pytest.mark.parametrize(("episodes", "max_steps", "most_steps"), [(10, 5_000, 500), (10, 5, 1), (1, 10 * LARGEST, LARGEST)])
def test_each_episode_has_an_equal_share_of_the_env_steps(episodes: int, max_steps: int, most_steps: int) -> None:
    assert EvaluationPlan.of(episodes, seed=1, copies=2, max_steps=max_steps).most_steps == most_steps


def test_seeds_are_cut_into_tickets_whose_orders_say_what_the_plan_says() -> None:
    learner = learner_with(A, B)
    found = orders(learner.coordinator.begin_evaluation(plan(5, 6, 7, send_rows=True), lambda episode, rows: None))
    assert [(order.ticket - FIRST_TICKET, order.seeds) for order in found] == [(0, (5, 6)), (1, (7,))]
    for order in found:
        assert (order.version, order.greedy, order.most_steps) == (0, False, 9)
        assert (order.send_rows, order.send_frames) == (True, True)


def test_the_episodes_are_in_the_order_of_the_seeds_whoever_answers_first() -> None:
    learner = learner_with(A, B)
    first, second = orders(learner.coordinator.begin_evaluation(plan(1, 2, 3)))
    for peer, order in ((B, second), (A, first)):
        learner.says(peer, answer(order))
    played = learner.coordinator.evaluation.end()
    assert [one.episode.length for one in played] == [1, 2, 3]
    assert evaluation_of(played).cut == 1


def test_nothing_of_an_evaluation_counts_in_the_next() -> None:
    learner = learner_with(A)
    (before,) = orders(learner.coordinator.begin_evaluation(plan(1, 2)))
    learner.says(A, answer(before))
    learner.coordinator.evaluation.end()
    assert learner.says(A, answer(before)) == [], "it is ignored while none is pending, too"
    (order,) = orders(learner.coordinator.begin_evaluation(plan(3, 4)))
    assert learner.evaluation.episodes_played == 0
    learner.says(A, answer(before))
    assert learner.evaluation.episodes_played == 0
    learner.says(A, answer(order))
    assert [one.episode.length for one in learner.coordinator.evaluation.end()] == [3, 4]
    assert learner.coordinator.members[A].strikes == 0


TEAMS: dict[str, Any] = {
    "seats": ("red", "blue"),
    "teams": ((0,), (1,)),
    "scripted": ("module:program",),
}
PLAN = EvaluationPlan((5, 6, 7, 8, 9, 1), copies=6, most_steps=9, opponents=(0, -1))


def asked(learner: Learner) -> Evaluate:
    """The order of the only ticket of this plan."""
    learner.joins(A)
    (order,) = orders(learner.coordinator.begin_evaluation(PLAN))
    return order


def against(order: Evaluate, opponents: Sequence[int | None], score: float = 0.5) -> Evaluated:
    played = zip(order.seeds, opponents, strict=True)
    episodes = tuple(Episode(0.0, seed, 0.0, (score,), opponent) for seed, opponent in played if seed is not None)
    return example(Evaluated, session=order.session, ticket=order.ticket, episodes=episodes, cut=(False,) * len(episodes))


def test_opponents_take_turns_and_each_meets_all_teams() -> None:
    """Wherever the plan is cut into tickets."""
    learner = Learner(lanes=1, **TEAMS)
    learner.joins(A)
    found = orders(learner.coordinator.begin_evaluation(replace(PLAN, copies=3)))
    found += orders(learner.says(A, against(found[0], found[0].opponents)))
    learner.says(A, against(found[1], found[1].opponents))
    assert [order.opponents for order in found] == [(0, 0, -1), (-1, 0, 0)]
    assert [order.teams for order in found] == [(0, 1, 0), (1, 0, 1)]
    assert learner.evaluation.done
    assert learner.coordinator.members[A].strikes == 0


@pytest.mark.parametrize(
    ("opponents", "score", "says"),
    [
        ((0, 0, -1, -1, 0, -1), 0.5, r"expected the opponents \(0, 0, -1, -1, 0, 0\), got \[0, 0, -1, -1, 0, -1\]"),
        ((0, 0, -1, -1, 0, 3), 0.5, r"expected the opponents \(.*\), got \[0, 0, -1, -1, 0, 3\]"),
        ((0, 0, -1, -1, 0, None), 0.5, "episode: expected an opponent, got None"),
        ((0, 0, -1, -1, 0, -2), 0.5, "episode: expected an opponent from -1, got -2"),
        ((0, 0, -1, -1, 0, 0), 0.6, r"episode: expected the score 0, 1 or 1/2, got 0\.6"),
        ((0, 0, -1, -1, 0, 0), math.nan, r"episode: expected the score 0, 1 or 1/2, got nan"),
    ],
)
def test_an_answer_of_other_matches_is_refused_and_its_ticket_is_dealt_again(
    opponents: Sequence[int | None], score: float, says: str
) -> None:
    learner = Learner(lanes=1, **TEAMS)
    order, evaluation = asked(learner), learner.evaluation
    wrong = against(order, opponents, score)
    why = evaluation.take_in(learner.coordinator.members[A], wrong).why
    assert re.fullmatch(f"evaluation of ticket {order.ticket}: {says}", why), why
    (again,) = orders(evaluation.deal(learner.coordinator.membership.active()))
    assert again == msgspec.structs.replace(order, keep=())
    learner.says(A, wrong)
    assert learner.coordinator.members[A].strikes == 1
    learner.says(A, against(order, order.opponents))
    assert evaluation.done


def test_without_teams_an_answer_names_no_opponents() -> None:
    learner = Learner(lanes=1, info_keys=("score",))
    order = asked(learner)
    assert order.opponents == order.teams == ()
    wrong = against(order, (0, 0, -1, -1, 0, 0))
    why = learner.evaluation.take_in(learner.coordinator.members[A], wrong).why
    assert why == f"evaluation of ticket {order.ticket}: episode: expected no opponent, got 0"


def test_while_it_is_pending_no_rollout_is_dealt() -> None:
    learner = Learner(lanes=1, max_lag=1)
    for peer in (A, B):
        learner.joins(peer)
    learner.deliver_round()
    learner.take()
    learner.coordinator.publish(1, PARAMETERS, BUFFERS)
    learner.coordinator.begin_evaluation(plan(1, 2))
    assert permits(learner.balanced(process_ends(learner.coordinator, "a", "killed"))) == []
    learner.coordinator.evaluation.end()
    assert [permit.lane for permit in permits(learner.coordinator.begin_update(), B)] == [0, 0]


def test_rows_come_in_the_order_of_the_episodes_with_their_numbers_in_the_plan() -> None:
    learner = learner_with(A)
    taken: list[tuple[int, int]] = []

    def take(episode: int, rows: EpisodeRows) -> None:
        taken.append((episode, rows.first_step))

    learner.coordinator.evaluation.most_copies = 2
    found = EvaluationPlan((2, 2, 2, 2), copies=2, most_steps=9, send_rows=True)
    (order,) = orders(learner.coordinator.begin_evaluation(found, take))
    while not learner.evaluation.done:
        for episode in (1, 0):
            for step in range(2):
                learner.says(A, fake_rows(order.session, order.ticket, episode, step))
        (order, *_) = orders(learner.says(A, answer(order))) or [order]
    assert taken == [(episode, step) for episode in range(4) for step in range(2)]


def test_a_rollout_on_a_ticket_of_an_evaluation_costs_the_evaluation_nothing() -> None:
    learner = learner_with(A)
    (order,) = orders(learner.coordinator.begin_evaluation(plan(1, 2)))
    rollout = fake_rollout(order.session, 0, order.ticket, 0, 0)
    learner.says(A, spoiled(rollout))
    learner.says(A, rollout)
    assert learner.coordinator.members[A].strikes == 1
    learner.says(A, answer(order))
    assert learner.evaluation.done


def shared(on_rows: OnRows | None = None) -> tuple[Learner, Evaluate, Evaluate]:
    """Worker B plays the only ticket of worker A as well. Returns their orders."""
    learner = learner_with(A, B)
    found = EvaluationPlan((2, 3), copies=2, most_steps=9, send_rows=on_rows is not None)
    (first,) = orders(learner.coordinator.begin_evaluation(found, on_rows))
    (second,) = of(learner.coordinator.share_evaluation(), Evaluate, B)
    assert (second.ticket, second.seeds) == (first.ticket, first.seeds)
    assert learner.coordinator.share_evaluation() == [], "two workers play it, and no other is free"
    return learner, first, second


@pytest.mark.parametrize("faster", [A, B])
def test_of_two_workers_that_play_a_ticket_the_first_answer_counts(faster: bytes) -> None:
    learner, first, second = shared()
    evaluation = learner.evaluation
    slower, late = (B, answer(second)) if faster == A else (A, answer(first))
    learner.says(faster, answer(first) if faster == A else answer(second))
    assert evaluation.done
    assert not evaluation.players
    held = [number for member in learner.coordinator.members.values() for number in member.tickets]
    assert max(held) < FIRST_TICKET, "both are free for rollouts"
    learner.says(slower, late)
    assert [one.episode.length for one in learner.coordinator.evaluation.end()] == [2, 3]
    assert learner.coordinator.members[slower].strikes == 0, "it is slow, and has done nothing wrong"


def test_a_worker_that_was_late_plays_only_if_nobody_else_does() -> None:
    learner, _, second = shared()
    learner.says(B, answer(second))
    learner.coordinator.evaluation.end()
    assert {peer for peer, _ in learner.coordinator.begin_evaluation(plan(1, 2, 3, 4, 5, 6))} == {B}
    outs = learner.balanced(process_ends(learner.coordinator, "b", "killed"))
    assert {peer for peer, order in outs if isinstance(order, Evaluate)} == {A}


def test_a_worker_that_was_late_plays_again_when_it_has_joined_again() -> None:
    learner, _, second = shared()
    learner.says(B, answer(second))
    learner.coordinator.evaluation.end()
    learner.balanced(process_ends(learner.coordinator, "a", "killed"))
    learner.joins(A, host="a", attempt=2)
    outs = learner.coordinator.begin_evaluation(plan(1, 2, 3, 4))
    assert {peer for peer, order in outs if isinstance(order, Evaluate)} == {A, B}


@pytest.mark.parametrize("lost", [A, B])
def test_a_ticket_that_two_play_stays_with_one_when_the_other_is_lost(lost: bytes) -> None:
    learner, first, second = shared()
    outs = learner.balanced(process_ends(learner.coordinator, lost.decode(), "killed"))
    assert not of(outs, Evaluate), "the other plays it already"
    learner.says(*((B, answer(second)) if lost == A else (A, answer(first))))
    assert [one.episode.length for one in learner.coordinator.evaluation.end()] == [2, 3]


def test_a_wrong_answer_of_one_leaves_the_ticket_with_the_other() -> None:
    learner, first, second = shared()
    learner.says(B, msgspec.structs.replace(answer(second), cut=()))
    assert learner.coordinator.members[B].strikes == 1
    assert [member.peer for member in learner.evaluation.players] == [A]
    learner.says(A, answer(first))
    assert learner.evaluation.done


def test_rows_of_one_worker_count_only_with_its_own_answer() -> None:
    used = list[tuple[int, EpisodeRows]]()
    learner, first, second = shared(lambda episode, rows: used.append((episode, rows)))
    learner.says(A, fake_rows(first.session, first.ticket, 0, 0))
    for episode in (0, 1):
        for step in (0, 1):
            learner.says(B, fake_rows(second.session, second.ticket, episode, step))
    assert used == []
    learner.says(B, msgspec.structs.replace(answer(second), episodes=(Episode(0.0, 2, 0.0),) * 2))
    assert [(episode, rows.session) for episode, rows in used] == [(n, second.session) for n in (0, 0, 1, 1)]
