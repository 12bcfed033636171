"""V-trace and whole episodes against slow sums that look like the papers; and what V-trace and GAE share at ends."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from millrace.learner.algorithms.returns import complete, vtrace
from millrace.protocol.arrays import Array
from tests.learner.algorithms.test_returns import GAMMA, Rows, lawful, rows, sum_tolerance
from tests.support.examples import examples
from tests.support.numbers.rounding import ELEMENTWISE, assert_within

BARS = st.floats(0.1, 1.5)


class OffPolicy(NamedTuple):
    """Rows, and log π − log μ [T, N] of their actions."""

    rows: Rows
    log_ratio: Array

    @property
    def sizes(self) -> OffPolicy:
        """See `Rows.sizes`."""
        return self._replace(rows=self.rows.sizes)

    def vtrace(
        self, gamma: float = GAMMA, lam: float = 1.0, rho_bar: float = 1.0, c_bar: float = 1.0
    ) -> tuple[Array, Array]:
        r = self.rows
        return vtrace(r.reward, r.values, self.log_ratio, r.ends, gamma, lam, rho_bar, c_bar)


@st.composite
def off_policy(draw: st.DrawFn) -> OffPolicy:
    r = draw(rows())
    generator = np.random.default_rng(draw(st.integers(0, 2**32)))
    return OffPolicy(r, generator.normal(size=r.reward.shape).astype(np.float32))


def on_policy(r: Rows) -> OffPolicy:
    return OffPolicy(r, np.zeros_like(r.reward))


def slow_vtrace(o: OffPolicy, gamma: float, lam: float, rho_bar: float, c_bar: float) -> tuple[Array, Array]:
    """v_s = V(x_s) + Σ_t γ^{t−s} (Π_{i=s}^{t−1} c_i) δ_t, up to the end of the episode or of the rollout (eq. 1); then
    ρ_s (r_s + γ v_{s+1} − V(x_s)), where v_{s+1} is V(x_{s+1}) at the end of what is summed, and mixed with it by λ.
    """
    r = o.rows
    T, N = r.reward.shape
    values, ratio = r.values.astype(float), np.exp(o.log_ratio.astype(float))
    rho, c = np.minimum(rho_bar, ratio), lam * np.minimum(c_bar, ratio)
    target, advantage = np.zeros((T, N)), np.zeros((T, N))
    for n in range(N):
        for s in reversed(range(T)):
            if not r.valid[s, n]:
                continue
            v, trace = values[s, n], 1.0
            for t in range(s, T):
                after = 0.0 if r.terminated[t, n] else values[t + 1, n]
                v += gamma ** (t - s) * trace * rho[t, n] * (r.reward[t, n] + gamma * after - values[t, n])
                trace *= c[t, n]
                if r.terminated[t, n] or r.truncated[t, n]:
                    break
            target[s, n] = v
            if r.terminated[s, n]:
                after = 0.0
            elif r.truncated[s, n] or s == T - 1:
                after = values[s + 1, n]
            else:
                after = lam * target[s + 1, n] + (1 - lam) * values[s + 1, n]
            advantage[s, n] = rho[s, n] * (r.reward[s, n] + gamma * after - values[s, n])
    return target, advantage


def vtrace_tolerances(
    o: OffPolicy, gamma: float, lam: float = 1.0, rho_bar: float = 1.0, c_bar: float = 1.0, log_ratio_error: float = 0.0
) -> tuple[Array, Array]:
    """How far targets and advantages, [T, N] each, may be from the exact ones of a log-ratio without its error.

    A term passes through the roundings of ρ, γ, δ and the advantage, and in each step through those of c, γ, λ and a sum. It
    has at most one ρ or c for each step and one more, whose relative errors are the absolute error of the log-ratio.
    """
    factors = len(o.rows.reward) + 1
    target, advantage = slow_vtrace(o.sizes, gamma, lam, rho_bar, c_bar)
    of_ratios = math.expm1(factors * log_ratio_error)
    roundings = factors * (ELEMENTWISE + 7)
    return sum_tolerance(target, roundings) + of_ratios * target, sum_tolerance(advantage, roundings) + of_ratios * advantage


@given(off_policy(), st.floats(0, 1), st.sampled_from([0.0, 0.7, 1.0]), BARS, BARS)
@examples(200)
def test_vtrace_is_the_papers_sum(o: OffPolicy, gamma: float, lam: float, rho_bar: float, c_bar: float) -> None:
    found = o.vtrace(gamma, lam, rho_bar, c_bar)
    exact, allowed = (each(o, gamma, lam, rho_bar, c_bar) for each in (slow_vtrace, vtrace_tolerances))
    for array, expected, tolerance in zip(found, exact, allowed, strict=True):
        assert array.dtype == np.float32
        assert_within(array, expected, tolerance)


@given(rows(), st.floats(0, 1))
@examples(100)
def test_on_policy_the_targets_are_the_return(r: Rows, gamma: float) -> None:
    """ρ = c = 1: the λ-return with λ = 1, which is all the reward to come, and a value where the sum is cut."""
    T = len(r.reward)
    target, _ = on_policy(r).vtrace(gamma)
    tolerance, _ = vtrace_tolerances(on_policy(r), gamma)
    for t, n in np.argwhere(r.valid):
        k, g, discount = t, 0.0, 1.0
        while True:
            g += discount * r.reward[k, n]
            discount *= gamma
            if r.terminated[k, n] or r.truncated[k, n] or k == T - 1:
                g += 0 if r.terminated[k, n] else discount * r.values[k + 1, n]
                break
            k += 1
        assert_within(target[t, n], g, tolerance[t, n])


@given(rows(), st.floats(0, 1), st.floats(0, 1))
@examples(100)
def test_on_policy_advantages_are_those_of_gae_for_any_lambda(r: Rows, gamma: float, lam: float) -> None:
    target, advantage = on_policy(r).vtrace(gamma, lam)
    of_target, of_advantage = vtrace_tolerances(on_policy(r), gamma, lam)
    assert_within(advantage, r.gae(gamma, lam), 2 * of_advantage)  # both are rounded
    assert_within(target, np.where(r.valid, r.gae(gamma, lam) + r.values[:-1], 0), 2 * of_target)


Estimate = Callable[[OffPolicy], tuple[Array, ...]]


def gae_of(o: OffPolicy) -> tuple[Array, ...]:
    return (o.rows.gae(),)


BOTH = pytest.mark.parametrize("estimate", [gae_of, OffPolicy.vtrace])


@BOTH
@given(o=off_policy())
@examples(100)
def test_a_batch_with_boundaries_is_its_episodes_put_together(estimate: Estimate, o: OffPolicy) -> None:
    r = o.rows
    T, N = r.reward.shape
    whole = estimate(o)
    for n in range(N):
        ends = [t for t in range(T) if r.terminated[t, n] or r.truncated[t, n]]
        for start in [t for t in range(T) if r.valid[t, n] and (t == 0 or not r.valid[t - 1, n])]:
            stop = next((end + 1 for end in ends if end >= start), T)
            reward, _, *flags = (array[start:stop, n : n + 1] for array in r)
            alone = OffPolicy(
                Rows(reward, r.values[start : stop + 1, n : n + 1], *flags), o.log_ratio[start:stop, n : n + 1]
            )
            for array, expected in zip(whole, estimate(alone), strict=True):
                np.testing.assert_array_equal(array[start:stop, n], expected[:, 0])


@BOTH
@given(o=off_policy(), rubbish=st.sampled_from([0.0, 1e30, np.nan]))
@examples(100)
def test_a_row_that_is_not_valid_changes_nothing(estimate: Estimate, o: OffPolicy, rubbish: float) -> None:
    r = o.rows
    reward, values, log_ratio = r.reward.copy(), r.values.copy(), o.log_ratio.copy()
    reward[~r.valid] = log_ratio[~r.valid] = rubbish
    before = np.zeros_like(r.valid)
    before[1:] = r.truncated[:-1] & ~r.terminated[:-1]
    values[:-1][~r.valid & ~before] = rubbish  # the value of a reset row's obs is used only to bootstrap a truncation
    with np.errstate(over="ignore"):
        found = estimate(OffPolicy(r._replace(reward=reward, values=values), log_ratio))
    for array, expected in zip(found, estimate(o), strict=True):
        np.testing.assert_array_equal(array, expected)
        assert not array[~r.valid].any()


def three_steps(terminated: bool, truncated: bool, ratio: float = 1.0) -> OffPolicy:
    """Three steps of one copy that end at t = 1, and the row that resets it; the action of t = 0 has this ratio."""
    flags = np.zeros((4, 1), bool)
    flags[1] = True
    reward = np.array([[1.0], [2.0], [99.0], [4.0]], np.float32)
    values = np.array([[10.0], [20.0], [30.0], [40.0], [50.0]], np.float32)
    log_ratio = np.log(np.array([[ratio], [1.0], [1.0], [1.0]], np.float32))
    return OffPolicy(Rows(reward, values, *lawful(flags & terminated, flags & truncated, np.array([True]))), log_ratio)


@BOTH
@pytest.mark.parametrize(("terminated", "truncated", "after"), [(True, False, 0.0), (False, True, 30.0), (True, True, 0.0)])
def test_what_stands_for_the_value_after_an_end(estimate: Estimate, terminated: bool, truncated: bool, after: float) -> None:
    """Nothing after termination, V of the true final observation after truncation, and terminated wins."""
    *target, advantage = estimate(three_steps(terminated, truncated))
    np.testing.assert_allclose(advantage[1], 2 + GAMMA * after - 20, rtol=1e-6)
    for each in target:
        np.testing.assert_allclose(each[1], 2 + GAMMA * after, rtol=1e-6)


@BOTH
@pytest.mark.parametrize(("terminated", "truncated"), [(True, False), (False, True), (True, True)])
def test_an_end_cuts(estimate: Estimate, terminated: bool, truncated: bool) -> None:
    """Even where no reset row stands between two episodes."""
    o = three_steps(terminated, truncated)
    r = o.rows._replace(valid=np.ones_like(o.rows.valid))
    reward, values = r.reward.copy(), r.values.copy()
    reward[3:] += 7
    values[4:] += 5
    found, later = (estimate(on_policy(each)) for each in (r, r._replace(reward=reward, values=values)))
    for a, b in zip(found, later, strict=True):
        assert a[2] != b[2]
        np.testing.assert_array_equal(a[:2], b[:2])


def test_the_advantage_looks_ahead_to_the_target_not_to_the_value() -> None:
    target, advantage = three_steps(True, False, ratio=0.5).vtrace()
    np.testing.assert_allclose(target[1], 2)
    np.testing.assert_allclose(advantage[0], 0.5 * (1 + GAMMA * 2 - 10), rtol=1e-6)


def test_weights_above_one_are_clipped_and_others_are_not() -> None:
    plain, more, less = (three_steps(False, True, ratio) for ratio in (1.0, 7.0, 0.25))
    for a, b in zip(plain.vtrace(), more.vtrace(), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(less.vtrace()[1][0], 0.25 * plain.vtrace()[1][0], rtol=1e-6)
    np.testing.assert_allclose(more.vtrace(rho_bar=3.0)[1][0], 3 * plain.vtrace()[1][0], rtol=1e-6)


@pytest.mark.parametrize("log_ratio", [-1e4, 1e4])
def test_ratios_beyond_all_floats_do_no_harm(log_ratio: float) -> None:
    o = three_steps(False, True)
    o.log_ratio[0] = log_ratio
    expected = o.rows.values[0] if log_ratio < 0 else on_policy(o.rows).vtrace()[0][0]
    np.testing.assert_allclose(o.vtrace()[0][0], expected)


@given(rows())
@examples(100)
def test_complete_rows_are_those_whose_episode_ends_in_the_rollout(r: Rows) -> None:
    ended = r.terminated | r.truncated
    found = complete(r.ends)
    for t, n in np.ndindex(*r.reward.shape):
        k = t
        while k < len(ended) and r.valid[k, n] and not ended[k, n]:
            k += 1
        assert found[t, n] == (k < len(ended) and bool(r.valid[k, n]) and bool(r.valid[t, n]))
