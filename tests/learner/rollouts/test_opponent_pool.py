"""Who meets whom in self-play, and how the ratings change. Pure: versions are numbers, and episodes are results."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from millrace.learner.rollouts.opponent_pool import FIRST_RATING, OpponentPool, PoolSettings, PoolState, Snapshot
from millrace.protocol.rollout import Episode
from tests.support.examples import examples

DRAWS = 2_000
CONFIDENCE = 4.5  # standard deviations; a fair draw is farther off once in 150,000 cases


def pool_of(
    *,
    window: int = 3,
    save_steps: int = 1,
    latest: float = 0.0,
    max_lag: int = 0,
    scripted: int = 0,
    made: int = 0,
    seed: int = 1,
) -> OpponentPool:
    """A pool that has seen so many versions, one env step apart."""
    pool = OpponentPool(PoolSettings(seed, window, save_steps, latest, max_lag, scripted))
    for version in range(made):
        pool.made(version, version)
    return pool


def drawn(pool: OpponentPool, version: int, draws: int = DRAWS) -> Counter[int]:
    """How often this version meets whom."""
    return Counter(pool.of(n % 7, n, version) for n in range(draws))


def is_fair(count: int, share: float) -> bool:
    """Whether so many of `DRAWS` are what a binomial distribution of this share gives."""
    return abs(count - DRAWS * share) <= CONFIDENCE * math.sqrt(DRAWS * share * (1 - share))


def met(opponent: int | None, score: float = 1.0) -> Episode:
    """An episode against this opponent. The score is the last fact."""
    return Episode(0.0, 1, 0.0, (0.25, score), opponent)


# ----------------------------------------------------------------------------------------------------------- snapshots


def test_a_snapshot_is_made_when_enough_env_steps_have_passed_and_once() -> None:
    pool = pool_of(window=9, save_steps=10)
    made = [pool.made(version, 4 * version) for version in range(8)]
    assert made == [True, False, False, True, False, False, True, False]
    assert [(each.version, each.env_steps) for each in pool.state.snapshots] == [(0, 0), (3, 12), (6, 24)]
    for version in (6, 5):  # a run that goes on makes the weights of its checkpoint again
        assert not pool.made(version, 1_000)


def test_a_snapshot_begins_with_the_rating_of_the_policy() -> None:
    pool = pool_of(made=1)
    pool.played([met(0)])
    pool.made(1, 1)
    assert [each.rating for each in pool.state.snapshots] == [FIRST_RATING - 4, FIRST_RATING + 4]


def test_the_first_snapshot_and_the_newest_are_kept() -> None:
    assert pool_of(window=3, made=20).versions == [0, 17, 18, 19]
    assert pool_of(window=3, max_lag=2, made=20).versions == [0, 15, 16, 17, 18, 19]


def test_evaluations_are_played_against_the_programs_or_else_against_the_first_snapshot() -> None:
    assert pool_of(made=20).yardsticks == (0,)
    assert pool_of(made=20, scripted=2).yardsticks == (-1, -2)
    assert pool_of(window=0, made=20, scripted=1).yardsticks == (-1,)


# ------------------------------------------------------------------------------------------------------------- matches


@examples(150)
@given(
    window=st.integers(1, 4),
    max_lag=st.integers(0, 4),
    save_steps=st.integers(1, 4),
    latest=st.sampled_from([0.0, 0.3, 1.0]),
    scripted=st.integers(0, 2),
    steps=st.lists(st.integers(1, 3), min_size=1, max_size=20),
)
def test_who_meets_a_version_is_settled_when_it_is_made(
    window: int, max_lag: int, save_steps: int, latest: float, scripted: int, steps: Sequence[int]
) -> None:
    """As long as it acts, later snapshots, ratings and draws change nothing. No snapshot that it can meet is forgotten."""
    pool = pool_of(window=window, max_lag=max_lag, save_steps=save_steps, latest=latest, scripted=scripted)
    snapshots: list[int] = []
    expected: dict[int, list[int]] = {}
    playing: dict[int, list[int]] = {}
    for version in range(len(steps)):
        if pool.made(version, sum(steps[:version])):
            snapshots.append(version)
        playing[version] = snapshots[-window:]
        expected[version] = [pool.of(lane, 2, version) for lane in range(12)]
        pool.played([met(each, 0.0) for each in expected[version]])
        for acting in range(max(0, version - max_lag), version + 1):
            assert [pool.of(lane, 2, acting) for lane in range(12)] == expected[acting]
            assert set(playing[acting]) <= set(pool.versions)
            assert set(expected[acting]) <= {acting, *playing[acting], *range(-scripted, 0)}
        assert len(pool.versions) <= 1 + window + max_lag


def test_all_that_play_are_met_equally_often() -> None:
    pool = pool_of(window=3, made=9, scripted=2)
    counts = drawn(pool, 8)
    assert sorted(counts) == [-2, -1, 6, 7, 8]
    assert all(is_fair(count, 1 / 5) for count in counts.values()), counts


@pytest.mark.parametrize("latest", [0.0, 0.5, 1.0])
def test_the_policy_meets_itself_in_a_share_of_the_rollouts(latest: float) -> None:
    """Version 8 is no snapshot: else it could also be drawn as one."""
    pool = pool_of(window=3, latest=latest, save_steps=5, made=8)
    counts = drawn(pool, 8)
    assert set(counts) <= {0, 5, 8}
    assert is_fair(counts[8], latest), counts


def test_the_first_version_meets_itself() -> None:
    assert set(drawn(pool_of(window=3), 0, 20)) == {0}


def test_without_snapshots_the_programs_play_alone() -> None:
    pool = pool_of(window=0, latest=1.0, scripted=2, made=5)
    assert pool.versions == []
    counts = drawn(pool, 4)
    assert sorted(counts) == [-2, -1]
    assert all(is_fair(count, 1 / 2) for count in counts.values()), counts


@pytest.mark.parametrize("differs", ["seed", "lane", "round_number"])
def test_each_rollout_draws_anew(differs: str) -> None:
    def of(number: int) -> int:
        where = {"lane": 1, "round_number": 3, differs: number}
        seed = where.pop("seed", 1)
        return pool_of(window=8, made=8, seed=seed).of(**where, version=7)

    assert len({of(number) for number in range(30)}) > 4


# ------------------------------------------------------------------------------------------------------------- ratings


@pytest.mark.parametrize(
    ("policy", "opponent", "expected_score"),
    [(1200.0, 1200.0, 1 / 2), (1200.0, 1600.0, 1 / 11), (1600.0, 1200.0, 10 / 11), (1200.0, 2000.0, 1 / 101)],
)
@pytest.mark.parametrize("score", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("program", [False, True])
def test_a_rating_changes_by_the_score_that_was_not_expected(
    policy: float, opponent: float, expected_score: float, score: float, program: bool
) -> None:
    pool = OpponentPool(
        PoolSettings(1, 3, 1, 0.0, 0, scripted=2),
        PoolState(rating=policy, snapshots=[Snapshot(0, 0, 900.0), Snapshot(4, 9, opponent)], scripted=[900.0, opponent]),
    )
    pool.played([met(-2 if program else 4, score)])
    change = 8 * (score - expected_score)
    changes = [change, 0.0, 0.0 if program else -change, 0.0, -change if program else 0.0]
    before = [policy, 900.0, opponent, 900.0, opponent]
    assert ratings(pool) == pytest.approx([rating + by for rating, by in zip(before, changes, strict=True)])


def test_of_three_equal_teams_each_wins_a_third() -> None:
    pool = OpponentPool(PoolSettings(1, 3, 1, 0.0, 0, scripted=1, teams=3))
    pool.played([met(-1, 1.0)])
    assert ratings(pool) == pytest.approx([FIRST_RATING + 8 * 2 / 3, FIRST_RATING - 8 * 2 / 3])


RESULTS = st.lists(st.tuples(st.integers(-2, 4), st.sampled_from([0.0, 0.5, 1.0])), max_size=60)


def ratings(pool: OpponentPool) -> list[float]:
    """All of them: of the policy, the snapshots and the programs."""
    return [pool.state.rating, *(each.rating for each in pool.state.snapshots), *pool.state.scripted]


@examples(100)
@given(results=RESULTS, cut=st.integers(0, 60))
def test_ratings_add_up_to_the_same_and_do_not_depend_on_which_update_used_the_episodes(
    results: list[tuple[int, float]], cut: int
) -> None:
    episodes = [met(*result) for result in results]
    at_once, in_two = (pool_of(window=5, made=5, scripted=2) for _ in range(2))
    before = sum(ratings(at_once))
    at_once.played(episodes)
    in_two.played(episodes[:cut])
    in_two.played(episodes[cut:])
    assert ratings(at_once) == ratings(in_two)
    assert sum(ratings(at_once)) == pytest.approx(before)


def test_ratings_depend_on_the_order_of_the_episodes() -> None:
    """What comes last counts more: it was expected less, because what came before has moved both ratings."""
    there, back = pool_of(made=1), pool_of(made=1)
    there.played([met(0, 1.0), met(0, 0.0)])
    back.played([met(0, 0.0), met(0, 1.0)])
    assert there.state.rating < FIRST_RATING < back.state.rating


def test_episodes_without_an_opponent_of_the_pool_change_no_rating() -> None:
    """Those of the policy against itself, and of lanes that still play against a snapshot that is forgotten."""
    pool = pool_of(window=1, made=4, scripted=1)
    before = ratings(pool)
    pool.played([met(None), met(4), met(2)])
    assert ratings(pool) == before


# --------------------------------------------------------------------------------------------------------------- state


@examples(50)
@given(results=RESULTS, later=RESULTS)
def test_a_run_that_goes_on_has_the_same_opponents_and_ratings(
    results: list[tuple[int, float]], later: list[tuple[int, float]]
) -> None:
    pool = pool_of(window=2, made=5, scripted=2, max_lag=1)
    pool.played(met(*result) for result in results)
    state = msgspec.json.decode(msgspec.json.encode(pool.state), type=PoolState)
    again = OpponentPool(PoolSettings(1, 2, 1, 0.0, 1, 2), state)
    for each in (pool, again):
        each.made(5, 5)
        each.played(met(*result) for result in later)
    assert (again.versions, again.yardsticks, ratings(again)) == (pool.versions, pool.yardsticks, ratings(pool))
    assert drawn(again, 5, 50) == drawn(pool, 5, 50)


def test_programs_that_a_state_does_not_know_begin_with_the_first_rating() -> None:
    assert OpponentPool(PoolSettings(1, 2, 1, 0.0, 0, 2), PoolState(scripted=[900.0])).state.scripted == [
        900.0,
        FIRST_RATING,
    ]


def test_the_metrics_are_the_rating_and_the_number_of_snapshots() -> None:
    pool = pool_of(made=2)
    pool.played([met(1)])
    assert pool.metrics() == {"self_play/elo": FIRST_RATING + 4, "self_play/snapshots": 2.0}
