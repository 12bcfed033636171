"""Running statistics: any way the rows are divided into batches gives the same, and only valid rows count."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from millrace.learner.algorithms.running_statistics import ROUNDING_64, ObservationNormalizer, RewardScaler, RunningMoments
from millrace.protocol.arrays import Array
from millrace.protocol.policy.layout import buffer_size
from millrace.protocol.policy.normalize import normalize
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec
from tests.support.examples import examples

GAMMA = 0.9


def through_a_file(state: dict[str, Any]) -> dict[str, Any]:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    loaded: dict[str, Any] = torch.load(file, weights_only=True)
    return loaded


@given(hnp.arrays(np.float64, (20, 2), elements=st.floats(-1e3, 1e3)), st.lists(st.integers(0, 20), max_size=4))
@examples(100)
def test_moments_do_not_depend_on_the_division_into_batches(rows: Array, cuts: list[int]) -> None:
    moments = RunningMoments((2,))
    for batch in np.split(rows, sorted(cuts)):
        moments.update(batch)
    assert moments.count == 20
    np.testing.assert_allclose(moments.mean, rows.mean(0), atol=1e-9)
    np.testing.assert_allclose(moments.std, np.where(rows.var(0) > 1e-9, rows.std(0), moments.std), rtol=1e-6)


def test_moments_keep_their_digits_far_from_zero() -> None:
    moments = RunningMoments()
    for _ in range(100):
        moments.update(1e6 + np.array([-1.0, 1.0]))
    np.testing.assert_allclose(moments.std, 1.0, rtol=1e-6)


SPEC = PolicySpec(
    (
        Leaf("a", "box", (2,), "float32"),
        Leaf("b", "discrete", (), "int64", (3,), (0,)),
        Leaf("c", "box", (8, 8, 3), "uint8", divisor=255),
        Leaf("d", "box", (1,), "float32"),
    ),
    ActionSpec("discrete", (), "int64", (2,), (0,)),
    normalize_observations=True,
)


def test_only_measured_features_of_valid_rows_are_counted() -> None:
    x = np.random.default_rng(0).normal(3, 2, (5, 4, 6)).astype(np.float32)
    valid = np.ones((5, 4), bool)
    valid[2, 1] = valid[3, 3] = False
    x[~valid] = np.nan
    normalizer = ObservationNormalizer(SPEC)
    assert normalizer.buffers().tolist() == [0.0] * 6 + [1.0] * 6
    normalizer.update(x, valid)
    buffers = normalizer.buffers()
    assert buffers.dtype == np.float32
    assert buffers.shape == (buffer_size(SPEC),)
    measured = [0, 1, 5]
    np.testing.assert_allclose(buffers[:6][measured], x[valid].mean(0)[measured], rtol=1e-5)
    np.testing.assert_allclose(buffers[6:][measured], x[valid].std(0)[measured], rtol=1e-5)
    assert buffers[[2, 3, 4]].tolist() == [0.0] * 3
    assert buffers[[8, 9, 10]].tolist() == [1.0] * 3


NUMBER = PolicySpec((Leaf("", "box", (1,), "float32"),), SPEC.action, normalize_observations=True)


def counted(batches: Iterable[Array]) -> tuple[Array, Array]:
    """The buffers after these batches [rows] of one feature, and what they were if each value counted as it is."""
    normalizer, moments = ObservationNormalizer(NUMBER), RunningMoments((1,))
    for rows in batches:
        normalizer.update(rows.astype(np.float32)[:, None, None], np.ones((len(rows), 1), bool))
        moments.update(rows.astype(np.float32)[:, None])
    return normalizer.buffers(), np.concatenate([moments.mean, moments.std]).astype(np.float32)


def noise(batches: int, rows: int = 500, scale: float = 1.0) -> list[Array]:
    generator = np.random.default_rng(batches)
    return [scale * generator.normal(size=rows) for _ in range(batches)]


@pytest.mark.parametrize("rows", [1, 500])
def test_values_that_are_not_far_count_as_they_are(rows: int) -> None:
    tails = [np.random.default_rng(n).standard_t(3, rows) for n in range(40)]
    growing = [(1 + n) * each for n, each in enumerate(noise(40, rows))]
    for batches in (tails, growing, [np.abs(each) // 3 for each in growing]):
        found, exact = counted(batches)
        assert found.tobytes() == exact.tobytes()


@pytest.mark.parametrize(
    ("batch", "rows"),
    [(0, 500), (1, 500), (30, 500), (30, 8), (0, 40), (1, 40), (2, 40), (3, 40), (0, 64), (1, 64), (0, 99), (1, 99), (0, 8)],
)
def test_one_value_does_not_hide_the_others(batch: int, rows: int) -> None:
    batches = noise(20_000 // rows, rows)
    batches[batch][3] = 1e6
    (mean, std), exact = counted(batches)
    assert exact[1] > 5_000
    assert abs(mean) < 0.05
    assert 0.95 < std < 1.05


@pytest.mark.parametrize("rows", [1, 40, 64, 99])
def test_one_value_of_the_first_rows_is_forgotten(rows: int) -> None:
    """However few an update has: A2C's presets, SAC, TD3 and DQN, and the episodes of a dataset."""
    batches = noise(20_000 // rows, rows)
    batches[0][0] = 1e6
    (mean, std), exact = counted(batches)
    assert exact[1] > 5_000
    assert abs(mean) < 0.05
    assert 0.95 < std < 1.05


def test_a_normalizer_that_was_saved_among_its_first_rows_goes_on_to_the_bit() -> None:
    batches = noise(6, 30)
    batches[0][3] = -1e6
    whole, normalizer = ObservationNormalizer(NUMBER), ObservationNormalizer(NUMBER)
    for rows in batches:
        restored = ObservationNormalizer(NUMBER)
        restored.load_state_dict(through_a_file(normalizer.state_dict()))
        normalizer = restored
        for each in (whole, normalizer):
            each.update(rows.astype(np.float32)[:, None, None], np.ones((30, 1), bool))
        assert normalizer.buffers().tobytes() == whole.buffers().tobytes()
    assert whole.buffers()[1] < 3


@pytest.mark.parametrize("shape", [(100, 1), (5, 2), (5,)])
def test_first_rows_that_cannot_be_are_refused(shape: tuple[int, ...]) -> None:
    normalizer = ObservationNormalizer(NUMBER)
    wrong = normalizer.state_dict() | {"first": torch.zeros(shape)}
    with pytest.raises(ValueError, match="observations: expected fewer than 100 first rows of 1 numbers"):
        normalizer.load_state_dict(wrong)


def test_nor_do_values_that_come_once_in_two_hundred_rows() -> None:
    batches = noise(40)
    for each in batches:
        each[:: len(each) // 2] = -1e6
    (_, std), exact = counted(batches)
    assert exact[1] > 50_000
    assert 0.9 < std < 2


@pytest.mark.parametrize(("grows", "updates"), [(1e2, 2), (1e4, 10)])
def test_a_feature_that_grows_for_good_is_followed(grows: float, updates: int) -> None:
    """Twenty thousand rows, and then others: within so many updates the spread is half of what it is if nothing is far."""
    found, exact = counted(noise(40) + noise(updates, scale=grows))
    assert found[1] > exact[1] / 2


def batch(
    reward: Array,
    lane: list[int],
    fresh: list[bool],
    ended: Array | None = None,
    first_valid: Array | None = None,
    copies: int = 2,
) -> Batch:
    """Rewards [T, ΣN] with ends; the row after an end is not valid."""
    T, N = reward.shape
    ended = np.zeros((T, N), bool) if ended is None else ended
    valid = np.ones((T, N), bool) if first_valid is None else np.broadcast_to(first_valid, (T, N)).copy()
    valid[1:] = ~ended[:-1]
    return Batch(
        obs=(np.zeros((T + 1, N, 1), np.float32),),
        action=np.zeros((T, N), np.int64),
        log_prob=np.zeros((T, N), np.float32),
        reward=reward.astype(np.float32),
        terminated=ended & (np.arange(T)[:, None] % 2 == 0),  # either flag ends
        truncated=ended & (np.arange(T)[:, None] % 2 == 1),
        valid=valid,
        state=np.zeros((len(lane), 0), np.float32),
        lane=np.array(lane),
        fresh=np.array(fresh),
        columns_per_rollout=copies,
        episodes=(),
    )


def slow_returns(columns: list[tuple[Array, Array, Array]]) -> list[float]:
    """The discounted returns of whole columns (reward, ended, valid), each one env copy's life."""
    found = []
    for reward, ended, valid in columns:
        g = 0.0
        for r, end, ok in zip(reward, ended, valid, strict=True):
            if ok:
                g = GAMMA * g + float(r)
                found.append(g)
            if end or not ok:
                g = 0.0
    return found


def slow_std(columns: list[tuple[Array, Array, Array]]) -> float:
    """Their standard deviation."""
    return float(np.std(slow_returns(columns)))


def lives(T: int, N: int) -> tuple[Array, Array, Array]:
    generator = np.random.default_rng(4)
    reward, ended = generator.normal(1, 1, (T, N)).astype(np.float32), generator.random((T, N)) < 0.3
    for t in range(1, T):
        ended[t] &= ~ended[t - 1]
    valid = np.ones((T, N), bool)
    valid[1:] = ~ended[:-1]
    return reward, ended, valid


def columns_of(life: tuple[Array, Array, Array]) -> list[tuple[Array, Array, Array]]:
    reward, ended, valid = life
    return [(reward[:, n], ended[:, n], valid[:, n]) for n in range(reward.shape[1])]


def test_returns_go_on_from_rollout_to_rollout_of_a_lane_and_its_copies() -> None:
    reward, ended, valid = life = lives(12, 4)  # lanes 0 and 1, two copies each
    scaler = RewardScaler(GAMMA)
    for at in (0, 4, 8):
        rows = slice(at, at + 4)
        scaled = scaler.count_and_scale(batch(reward[rows], [0, 0, 1, 1], [at == 0] * 4, ended[rows], valid[at]))
    np.testing.assert_allclose(scaled, reward[8:] / slow_std(columns_of(life)), rtol=1e-5)


def test_a_lane_may_stand_twice_in_a_batch_in_its_own_order() -> None:
    life = lives(8, 4)
    wide = [np.concatenate([a[:4, :2], a[4:, :2], a[:4, 2:], a[4:, 2:]], 1) for a in life]
    scaler = RewardScaler(GAMMA)
    scaled = scaler.count_and_scale(batch(wide[0], [0] * 4 + [1] * 4, [True, True, False, False] * 2, wide[1], wide[2][0]))
    np.testing.assert_allclose(scaled, wide[0] / slow_std(columns_of(life)), rtol=1e-5)


def test_a_fresh_lane_starts_from_zero() -> None:
    first, second = lives(6, 2), lives(5, 2)
    scaler = RewardScaler(GAMMA)
    scaler.count_and_scale(batch(first[0], [0, 0], [True, True], first[1], first[2][0]))
    scaled = scaler.count_and_scale(batch(second[0], [0, 0], [True, True], second[1], second[2][0]))
    np.testing.assert_allclose(scaled, second[0] / slow_std(columns_of(first) + columns_of(second)), rtol=1e-5)


def test_a_fresh_lane_may_have_more_copies_than_it_had() -> None:
    first, second = lives(6, 2), lives(5, 3)
    scaler = RewardScaler(GAMMA)
    scaler.count_and_scale(batch(first[0], [0, 0], [True] * 2, first[1], first[2][0]))
    scaled = scaler.count_and_scale(batch(second[0], [0, 0, 0], [True] * 3, second[1], second[2][0], copies=3))
    np.testing.assert_allclose(scaled, second[0] / slow_std(columns_of(first) + columns_of(second)), rtol=1e-5)


def test_the_reward_of_a_row_that_is_not_valid_changes_nothing() -> None:
    reward, ended, valid = lives(12, 2)
    assert not valid.all()
    other = np.where(valid, reward, np.float32(1e6))
    scaled = [RewardScaler(GAMMA).count_and_scale(batch(r, [0, 0], [True, True], ended)) for r in (reward, other)]
    np.testing.assert_array_equal(scaled[0][valid], scaled[1][valid])


def test_a_scaled_reward_is_clipped() -> None:
    reward = np.zeros((2_000, 2))
    reward[50] = 1e6, -1e6
    scaler = RewardScaler(GAMMA)
    scaled = scaler.count_and_scale(batch(reward, [0, 0], [True, True]))
    assert 1e6 / scaler.std > 15
    assert sorted(set(scaled.ravel().tolist())) == [-10, 0, 10]


def test_what_never_varied_is_divided_by_one() -> None:
    constant = batch(np.full((1, 3), 0.3), [0, 0, 0], [True] * 3, copies=3)
    np.testing.assert_array_equal(RewardScaler(GAMMA).count_and_scale(constant), constant.reward)
    moments = RunningMoments((2,))
    for _ in range(10):
        moments.update(np.stack([np.full(7, 123.456), np.arange(7) * 1e-9], -1))
    np.testing.assert_allclose(moments.std, [1, 2e-9], rtol=1e-6)  # small is not constant


def test_a_large_value_that_varies_little_is_not_clipped() -> None:
    """The time of day in seconds, during ten minutes: all features were at the bounds of ±10."""
    normalizer, seconds = ObservationNormalizer(CLOCK), (1.7e9 + np.arange(600.0)).reshape(600, 1, 1)
    normalizer.update(seconds, np.ones((600, 1), bool))
    normalized = normalize(seconds, *np.split(normalizer.buffers(), 2))
    np.testing.assert_allclose(np.square(normalized, dtype=np.float64).mean(), 1, rtol=1e-5)
    assert len(np.unique(normalized)) == 600


CLOCK = PolicySpec((Leaf("", "box", (1,), "float64"),), SPEC.action, normalize_observations=True)


def test_a_float64_feature_has_its_own_spread_however_small_beside_its_mean() -> None:
    normalizer, rows = ObservationNormalizer(CLOCK), 1e7 + np.random.default_rng(0).normal(size=(20, 100, 1))
    for some in np.split(rows, 4):
        normalizer.update(some, np.ones((5, 100), bool))
    mean, std = normalizer.buffers().astype(np.float64)
    np.testing.assert_allclose(std, np.sqrt(np.square(rows - mean).mean()), rtol=1e-5)
    assert abs(std - 1) < 0.1
    never = RunningMoments((), ROUNDING_64)
    for _ in range(10):
        never.update(np.full(5_000, 1e7 / 3))
    assert never.std == 1


@pytest.mark.parametrize("steps", [1, 4])
def test_the_state_goes_through_a_file(steps: int) -> None:
    reward, ended, valid = lives(8, 2)
    scaler, again = RewardScaler(GAMMA), RewardScaler(GAMMA)
    scaler.count_and_scale(batch(reward[:4], [0, 0], [True, True], ended[:4], valid[0]))
    again.load_state_dict(through_a_file(scaler.state_dict()))
    following = batch(reward[4 : 4 + steps], [0, 0], [False, False], ended[4 : 4 + steps], valid[4])
    np.testing.assert_array_equal(again.count_and_scale(following), scaler.count_and_scale(following))

    x = np.random.default_rng(0).normal(size=(2, 3, 6)).astype(np.float32)
    normalizer, restored = ObservationNormalizer(SPEC), ObservationNormalizer(SPEC)
    normalizer.update(x, np.ones((2, 3), bool))
    restored.load_state_dict(through_a_file(normalizer.state_dict()))
    for each in (normalizer, restored):
        each.update(x * 2, np.ones((2, 3), bool))
    np.testing.assert_array_equal(restored.buffers(), normalizer.buffers())
