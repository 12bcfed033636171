"""Rows of played episodes count only with their answer: what a worker sent before it left spoils nothing. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.protocol.arrays import Array
from millrace.protocol.bounds import MOST_FRAMES
from millrace.protocol.messages import EpisodeRows, Evaluate, Evaluated, Goodbye
from millrace.protocol.rollout import Episode
from millrace.protocol.rows.played import reason_to_reject
from millrace.protocol.rows.rollout_checks import LARGEST_REWARD
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec
from tests.learner.rollouts.test_ticket_coordinator import Learner, of
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import fake_rows

A, B = b"a", b"b"
MOST_STEPS = 2_000


class Played:
    """One episode of an evaluation that wants rows, and two workers that may play it."""

    def __init__(self, *, send_frames: bool = False) -> None:
        self.learner = Learner(publish=False)
        self.learner.publish(0)
        for peer in (A, B):
            self.learner.joins(peer, host=peer.decode())
        self.taken: list[tuple[int, int]] = []
        plan = EvaluationPlan((7,), 1, MOST_STEPS, send_rows=True, send_frames=send_frames)
        self.order = self.order_in(self.learner.coordinator.begin_evaluation(plan, self.take), A)

    def order_in(self, outs: Sequence[Outgoing], peer: bytes) -> Evaluate:
        (order,) = of(outs, Evaluate, peer)
        return order

    def take(self, episode: int, rows: EpisodeRows) -> None:
        self.taken.append((episode, rows.first_step))

    def rows(self, step: int, **changes: object) -> EpisodeRows:
        row = fake_rows(self.order.session, self.order.ticket, 0, step)
        fields = {name: getattr(row, name) for name in row.__struct_fields__}
        return EpisodeRows(**{**fields, "terminated": np.zeros(1, bool), **changes})

    def answer(self, length: int) -> Evaluated:
        return example(
            Evaluated,
            session=self.order.session,
            ticket=self.order.ticket,
            episodes=(Episode(0.0, length, 0.0),),
            cut=(False,),
        )

    def strikes(self, peer: bytes = A) -> int:
        return self.learner.coordinator.members[peer].strikes


def test_rows_of_a_worker_that_left_do_not_count() -> None:
    played = Played()
    for step in range(5):  # more rows than the episode has
        played.learner.says(A, played.rows(step))
    outs = played.learner.says(A, Goodbye(played.order.session, "told to stop", ()))
    played.order = played.order_in(outs, B)
    assert played.taken == []
    for step in range(2):
        played.learner.says(B, played.rows(step))
    played.learner.says(B, played.answer(2))
    assert played.learner.evaluation.done
    assert played.taken == [(0, 0), (0, 1)]


def test_rows_before_an_answer_that_they_do_not_fit_are_played_again() -> None:
    played = Played()
    for step in range(5):
        played.learner.says(A, played.rows(step))
    played.order = played.order_in(played.learner.says(A, played.answer(2)), A)
    assert played.taken == []
    for step in (0, 0, 1, 1):  # a message may come twice
        played.learner.says(A, played.rows(step))
    played.learner.says(A, played.answer(2))
    assert played.learner.evaluation.done
    assert played.taken == [(0, 0), (0, 1)]
    assert played.strikes() == 0, "the network may lose a message"


def test_the_env_steps_of_each_answer_that_ends_a_ticket_count_even_if_they_are_played_again() -> None:
    played = Played()
    member = played.learner.coordinator.members[A]
    played.order = played.order_in(played.learner.says(A, played.answer(2)), A)  # its rows are missing
    assert member.ended_steps == 2
    too_long = MOST_STEPS + 1
    played.order = played.order_in(played.learner.says(A, played.answer(too_long)), A)
    assert (member.ended_steps, member.strikes) == (2 + too_long, 1)
    played.learner.says(A, played.rows(0))
    for _ in range(2):  # the second time, the ticket has ended
        played.learner.says(A, played.answer(1))
        assert member.ended_steps == 3 + too_long


def test_what_another_worker_says_of_a_ticket_changes_nothing() -> None:
    played = Played()
    session = played.learner.session(B)
    for step in range(5):
        played.learner.says(B, msgspec.structs.replace(played.rows(step), session=session))
    played.learner.says(B, msgspec.structs.replace(played.answer(5), session=session))
    assert played.learner.evaluation.episodes_played == 0
    played.learner.says(A, played.rows(0))
    played.learner.says(A, played.answer(1))
    assert played.learner.evaluation.done
    assert (played.taken, played.strikes(B)) == ([(0, 0)], 0)


def test_rows_that_were_not_asked_for_are_not_kept() -> None:
    """A worker could send as many as an episode may have, of each ticket."""
    played = Played()
    played.learner.coordinator.evaluation.end()
    played.learner.says(A, played.rows(0))  # while no evaluation is pending
    plan = EvaluationPlan((7,), 1, MOST_STEPS)
    played.order = played.order_in(played.learner.coordinator.begin_evaluation(plan), A)
    played.learner.says(A, played.rows(0))
    assert played.learner.evaluation._rows == {}
    played.learner.says(A, played.answer(1))
    assert played.learner.evaluation.done
    assert played.strikes() == 0


def test_an_answer_holds_nothing_but_what_was_asked_for() -> None:
    played = Played()
    episode = Episode(0.0, 1, 0.0, (1.0,) * 60_000)
    outs = played.learner.says(A, msgspec.structs.replace(played.answer(1), episodes=(episode,)))
    assert played.strikes() == 1
    assert [order.ticket for order in of(outs, Evaluate)] == [played.order.ticket], "it is not played again"


@pytest.mark.parametrize(
    "changes",
    [
        {"episodes": ()},
        {"cut": ()},
        {"episodes": (Episode(0.0, MOST_STEPS + 1, 0.0),)},
        {"episodes": (Episode(math.nan, 1, 0.0),)},
        {"episodes": (Episode(1e39, 1, 0.0),)},
    ],
    ids=["no episode", "no mark", "too long", "no return", "a return of no reward"],
)
def test_an_answer_that_no_player_gives_is_a_strike(changes: dict[str, object]) -> None:
    played = Played()
    played.learner.says(A, msgspec.structs.replace(played.answer(1), **changes))
    assert played.strikes() == 1


@pytest.mark.parametrize("facts", [(), (1.0, 2.0), (math.inf,)])
def test_an_answer_with_wrong_facts_is_a_strike(facts: tuple[float, ...]) -> None:
    played = Played()
    evaluation = played.learner.evaluation
    evaluation._run = msgspec.structs.replace(evaluation._run, info_keys=("a number",))
    answer = played.answer(1)
    episodes = tuple(msgspec.structs.replace(episode, facts=facts) for episode in answer.episodes)
    played.learner.says(A, msgspec.structs.replace(answer, episodes=episodes))
    assert played.strikes() == 1


def frames(height: int = 2, width: int = 2, count: int = 2) -> Array:
    return np.zeros((count, height, width, 3), np.uint8)


def test_frames_that_were_not_asked_for_are_a_strike() -> None:
    played = Played()
    played.learner.says(A, played.rows(0, frames=frames()))
    assert played.strikes() == 1


@pytest.mark.parametrize("bad", [None, frames(0), frames(2, 0), frames(count=1), np.zeros((2, 2), np.uint8)])
def test_the_first_rows_carry_frames_if_frames_were_asked_for(bad: Array | None) -> None:
    played = Played(send_frames=True)
    played.learner.says(A, played.rows(0, frames=bad))
    assert played.strikes() == 1


def test_frames_have_one_size_and_end_at_a_limit() -> None:
    played = Played(send_frames=True)
    for step in range(MOST_FRAMES - 1):
        played.learner.says(A, played.rows(step, frames=frames()))
        if step == 3:
            played.learner.says(A, played.rows(4, frames=frames(3)))
            assert played.strikes() == 1
    assert played.strikes() == 1
    played.learner.says(A, played.rows(MOST_FRAMES - 1, frames=frames()))
    assert played.strikes() == 2
    played.learner.says(A, played.rows(MOST_FRAMES - 1))
    played.learner.says(A, played.answer(MOST_FRAMES))
    assert played.learner.evaluation.done


@pytest.mark.parametrize(
    "changes",
    [
        {"episode": 1},
        {"obs": (np.full((2, 1), np.nan, np.float32),)},
        {"action": np.array([2])},
        {"action": np.array([-1])},
        {"terminated": np.array([255], np.uint8).view(bool)},
    ],
    ids=["episode", "observation", "choice", "negative choice", "flag"],
)
def test_rows_hold_only_values_that_a_dataset_may_hold(changes: dict[str, object]) -> None:
    played = Played()
    played.learner.says(A, played.rows(0, **changes))
    assert played.strikes() == 1


@pytest.mark.parametrize("flag", ["terminated", "truncated"])
def test_no_row_follows_the_end_of_an_episode(flag: str) -> None:
    played = Played()
    played.learner.says(A, played.rows(0, **{flag: np.ones(1, bool)}))
    played.learner.says(A, played.rows(0))  # a copy of a message that has come is ignored
    assert played.strikes() == 0
    played.learner.says(A, played.rows(1))
    assert played.strikes() == 1


def test_rows_may_have_a_part_without_elements() -> None:
    played, empty = Played(), np.zeros((2, 0), bool)
    row, run = played.rows(0), played.learner.coordinator.run
    policy = PolicySpec((Leaf("", "box", (0,), "bool"),), ActionSpec("discrete", (), "int64", (2,), (0,)))
    run = msgspec.structs.replace(run, policy=policy)
    assert reason_to_reject(msgspec.structs.replace(row, obs=(empty,)), [], run, MOST_STEPS, with_frames=False) == ""


def of_seats(played: Played, count: int) -> EpisodeRows:
    """A row of this number of seats."""
    return played.rows(0, obs=(np.zeros((2, count, 1), np.float32),), action=np.zeros((1, count), np.int64))


@pytest.mark.parametrize("count", [0, 1, 3])
def test_rows_are_of_all_seats_of_the_run(count: int) -> None:
    played = Played()
    evaluation = played.learner.evaluation
    played.learner.says(A, of_seats(played, 2))
    assert played.strikes() == 1, "the run has no seats"
    evaluation._run = msgspec.structs.replace(evaluation._run, seats=("black", "white"))
    for rows in (played.rows(0), of_seats(played, count)):
        assert "expected float32[2, 2, 1], got" in reason_to_reject(rows, [], evaluation._run, MOST_STEPS, with_frames=False)
        played.learner.says(A, rows)
    assert A not in played.learner.coordinator.members, "three strikes"


def test_the_first_wrong_value_of_a_row_is_named_by_its_seat() -> None:
    played = Played()
    run = msgspec.structs.replace(played.learner.coordinator.run, seats=("black", "white"))
    rows = msgspec.structs.replace(of_seats(played, 2), action=np.array([[0, 2]]))
    assert (
        reason_to_reject(rows, [], run, MOST_STEPS, with_frames=False) == "action: expected 0 to 1, got 2 at row 0, seat 1"
    )


def test_a_return_is_one_that_the_rewards_of_all_seats_can_give() -> None:
    played = Played()
    evaluation = played.learner.evaluation
    evaluation._run = msgspec.structs.replace(evaluation._run, seats=("black", "white"))
    for total, strikes in ((2.001 * LARGEST_REWARD, 1), (math.nan, 2), (2 * LARGEST_REWARD, 2)):
        played.learner.says(A, of_seats(played, 2))
        played.learner.says(A, msgspec.structs.replace(played.answer(1), episodes=(Episode(total, 1, 0.0, (0.0, 0.0)),)))
        assert played.strikes() == strikes
