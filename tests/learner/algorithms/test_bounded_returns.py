"""Rewards of a distributional critic: values stay within the bound of its categories, and are used fully."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from millrace.learner.algorithms.bounded_returns import BoundedReturns
from millrace.learner.algorithms.running_statistics import RewardScaler
from millrace.protocol.arrays import Array, Bools, Floats
from tests.learner.algorithms.test_running_statistics import batch, through_a_file

GAMMA = 0.9
BOUND = 5.0


@dataclasses.dataclass
class Life:
    """The rows [T, N] of some env copies."""

    reward: Floats
    terminated: Bools
    truncated: Bools

    def count_into(self, scaler: RewardScaler, cuts: Sequence[int] = ()) -> None:
        """Count all rows, cut into several rollouts."""
        T, N = self.reward.shape
        valid = np.ones((T, N), bool)
        valid[1:] = ~(self.terminated | self.truncated)[:-1]
        for first, last in zip([0, *cuts], [*cuts, T], strict=True):
            rows = slice(first, last)
            whole = batch(self.reward[rows], [0] * N, [first == 0] * N, copies=N)
            scaler.count(replace(whole, terminated=self.terminated[rows], truncated=self.truncated[rows], valid=valid[rows]))


def life(rewards: Sequence[float], end: str | None) -> Life:
    """One env copy with one episode, which is terminated or truncated after its last reward."""
    reward = np.array(rewards, np.float32)[:, None]
    last = np.zeros(reward.shape, bool)
    last[-1] = True
    return Life(reward, last & (end == "terminated"), last & (end == "truncated"))


def random_life(T: int, N: int) -> Life:
    generator = np.random.default_rng(7)
    ended = generator.random((T, N)) < 0.2
    for t in range(1, T):
        ended[t] &= ~ended[t - 1]  # the row after an end only resets the copy
    kind = generator.random((T, N)) < 0.5
    return Life(generator.normal(0.5, 1, (T, N)).astype(np.float32), ended & kind, ended & ~kind)


def slow_largest(lived: Life) -> float:
    """The largest absolute value: of a discounted return, or of an episode that was truncated and goes on as on average."""
    largest = 0.0
    for rewards, terminated, truncated in zip(
        lived.reward.T, lived.terminated.T, lived.truncated.T, strict=True
    ):  # a column at a time
        episode: list[float] = []
        resets = False
        for reward, terminates, truncates in zip(rewards, terminated, truncated, strict=True):
            if resets:
                resets = False
                continue
            episode.append(float(reward))
            newest_first = list(reversed(episode))
            largest = max(largest, abs(sum(GAMMA**i * r for i, r in enumerate(newest_first))))
            if truncates and len(episode) > 1:
                weights = [GAMMA**i for i in range(len(episode) - 1)]
                mean = sum(w * r for w, r in zip(weights, newest_first[1:], strict=True)) / sum(weights)
                largest = max(largest, abs(mean) / (1 - GAMMA))
            if terminates or truncates:
                episode, resets = [], True
    return largest


def divisor(scaler: RewardScaler) -> float:
    return 1 / float(scaler.scaled(np.ones(1, np.float32))[0])


@pytest.mark.parametrize("cuts", [(), (1,), (5, 6, 17)])
def test_the_largest_value_sets_the_scale_however_the_rows_are_cut_into_rollouts(cuts: Sequence[int]) -> None:
    lived, scaler = random_life(24, 3), BoundedReturns(GAMMA, 0.1)
    lived.count_into(scaler, cuts)
    assert slow_largest(lived) / 0.1 > scaler.std
    assert divisor(scaler) == pytest.approx(slow_largest(lived) / 0.1, rel=1e-6)


def test_if_values_are_far_below_the_bound_the_deviation_sets_the_scale() -> None:
    scaler = BoundedReturns(GAMMA, 1e6)
    random_life(24, 3).count_into(scaler)
    assert divisor(scaler) == pytest.approx(scaler.std, rel=1e-6)


def test_an_episode_with_a_short_time_limit_would_have_gone_on() -> None:
    """Its discounted return is 2.71, and the value of -1 for ever is -10."""
    scaler = BoundedReturns(GAMMA, BOUND)
    life([-1.0] * 3, "truncated").count_into(scaler)
    assert scaler.scaled(np.full(1, -1, np.float32))[0] / (1 - GAMMA) == pytest.approx(-BOUND)


def test_a_penalty_sets_the_scale_as_a_reward_of_its_size_does() -> None:
    """The returns are -4, -7.6 and -10.84, whose deviation is less than 4."""
    scaler = BoundedReturns(GAMMA, 1.0)
    life([-4.0] * 3, "terminated").count_into(scaler)
    assert divisor(scaler) == pytest.approx(10.84, rel=1e-6)


def test_an_episode_that_terminates_would_not() -> None:
    scaler = BoundedReturns(GAMMA, BOUND)
    life([-4.0] * 3, "terminated").count_into(scaler)
    assert divisor(scaler) == pytest.approx(max(scaler.std, 4 * 2.71 / BOUND))


def test_a_penalty_that_is_paid_with_a_truncation_is_not_paid_for_ever() -> None:
    scaler = BoundedReturns(GAMMA, BOUND)
    life([1.0] * 5 + [-100.0], "truncated").count_into(scaler)
    largest = 100 - sum(GAMMA**i for i in range(1, 6))
    assert divisor(scaler) == pytest.approx(max(scaler.std, largest / BOUND))


def test_a_truncated_episode_of_one_step_says_nothing() -> None:
    scaler = BoundedReturns(GAMMA, BOUND)
    life([50.0], "truncated").count_into(scaler)
    assert divisor(scaler) == pytest.approx(50 / BOUND)


def test_without_a_discount_only_returns_count() -> None:
    scaler = BoundedReturns(1.0, BOUND)
    life([5.0] * 4, "truncated").count_into(scaler)
    scaler.may_last(np.ones(1, np.float32), np.ones(1, np.float32))
    assert divisor(scaler) == pytest.approx(max(scaler.std, 20 / BOUND))


def test_a_reward_that_may_last_is_worth_what_it_is_for_ever() -> None:
    scaler = BoundedReturns(GAMMA, BOUND)
    life([0.0] * 4, "truncated").count_into(scaler)
    assert divisor(scaler) == 1
    scaler.may_last(np.array([0, 1, -2], np.float32), np.full(3, GAMMA, np.float32))
    assert divisor(scaler) == pytest.approx(2 / (1 - GAMMA) / BOUND)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_sum_of_rewards_that_may_last_counts_as_its_mean_however_many_steps_it_has(steps: int) -> None:
    """Where an episode is truncated, it has fewer than the others."""
    scaler = BoundedReturns(GAMMA, BOUND)
    reward = [1 + GAMMA + GAMMA**2, 2 * sum(GAMMA**i for i in range(steps))]
    scaler.may_last(np.array(reward, np.float32), np.array([GAMMA**3, GAMMA**steps], np.float32))
    assert divisor(scaler) == pytest.approx(2 / (1 - GAMMA) / BOUND)


def test_rewards_before_an_episode_terminates_do_not_last() -> None:
    scaler = BoundedReturns(GAMMA, BOUND)
    scaler.may_last(np.array([50, 1], np.float32), np.array([0, GAMMA], np.float32))
    assert divisor(scaler) == pytest.approx(50 / BOUND)


def test_a_discount_that_float32_rounds_to_1_does_not_make_a_reward_infinite() -> None:
    gamma = 1 - 1e-9
    scaler = BoundedReturns(gamma, BOUND)
    scaler.may_last(np.ones(1, np.float32), np.array([gamma], np.float32))
    assert divisor(scaler) == pytest.approx(1 / (1 - gamma) / BOUND)


def test_a_saved_state_goes_on() -> None:
    lived, cut = random_life(24, 3), 11
    scaler, again = BoundedReturns(GAMMA, 0.1), BoundedReturns(GAMMA, 0.1)
    first = Life(lived.reward[:cut], lived.terminated[:cut], lived.truncated[:cut])
    first.count_into(scaler)
    again.load_state_dict(through_a_file(scaler.state_dict()))
    valid = ~(lived.terminated | lived.truncated)[cut - 1 : -1]
    rest = slice(cut, None)
    following = replace(
        batch(lived.reward[rest], [0] * 3, [False] * 3, copies=3),
        terminated=lived.terminated[rest],
        truncated=lived.truncated[rest],
        valid=valid,
    )
    for each in (scaler, again):
        each.count(following)
    assert divisor(scaler) == divisor(again) == pytest.approx(slow_largest(lived) / 0.1, rel=1e-6)


def test_rewards_stay_float32() -> None:
    reward: Array = np.arange(3, dtype=np.float32)
    assert BoundedReturns(GAMMA, BOUND).scaled(reward).dtype == np.float32
