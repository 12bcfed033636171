"""GAE and the discounted return against slow sums that look like the papers, over random episode boundaries."""

from __future__ import annotations

from typing import NamedTuple

import hypothesis.extra.numpy as hnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from millrace.learner.algorithms.returns import EpisodeEnds, discounted_return, gae
from millrace.protocol.arrays import Array
from tests.support.examples import examples
from tests.support.numbers.rounding import UNIT, assert_within

GAMMA, LAMBDA = 0.9, 0.8


class Rows(NamedTuple):
    """Columns of a batch that returns and advantages are computed from."""

    reward: Array  # [T, N]
    values: Array  # [T+1, N]
    terminated: Array
    truncated: Array
    valid: Array

    @property
    def ends(self) -> EpisodeEnds:
        return EpisodeEnds(self.terminated, self.truncated, self.valid)

    @property
    def sizes(self) -> Rows:
        """Rows whose r + γ V′ − V is |r| + γ |V′| + |V| of these, so that sums of them are sums of absolute values."""
        reward, values = np.abs(self.reward.astype(float)), np.abs(self.values.astype(float))
        return self._replace(reward=reward + 2 * values[:-1], values=values)

    def gae(self, gamma: float = GAMMA, gae_lambda: float = LAMBDA) -> Array:
        return gae(self.reward, self.values, self.ends, gamma, gae_lambda)


def lawful(terminated: Array, truncated: Array, first: Array) -> tuple[Array, Array, Array]:
    """Flags that keep the row format: the row after an end is not valid and ends nothing."""
    terminated, truncated, valid = terminated.copy(), truncated.copy(), np.ones_like(terminated)
    valid[0] = first
    for t in range(len(valid)):
        if t:
            valid[t] = ~(terminated[t - 1] | truncated[t - 1])
        terminated[t] &= valid[t]
        truncated[t] &= valid[t]
    return terminated, truncated, valid


def sum_tolerance(sizes: Array, roundings: int) -> Array:
    """How far a float32 sum may be from the exact one, where each term passes through at most so many roundings.

    `sizes` are the sums of the absolute values of the terms. The bound is that of the worst case (Higham 2002, "Accuracy and
    stability of numerical algorithms", lemma 3.1): powers of a rounded γ repeat one and the same error.
    """
    return np.asarray(roundings * UNIT / (1 - roundings * UNIT) * sizes)


@st.composite
def rows(draw: st.DrawFn) -> Rows:
    T, N = draw(st.integers(1, 12)), draw(st.integers(1, 4))
    generator = np.random.default_rng(draw(st.integers(0, 2**32)))
    clock = draw(hnp.arrays(bool, (T, N))) & (generator.random((T, N)) < 0.5)
    terminated, truncated, valid = lawful(draw(hnp.arrays(bool, (T, N))), clock, draw(hnp.arrays(bool, N)))
    reward, values = (generator.normal(size=(steps, N)).astype(np.float32) for steps in (T, T + 1))
    return Rows(reward, values, terminated, truncated, valid)


def slow_gae(r: Rows, gamma: float, gae_lambda: float) -> Array:
    """Â_t = Σ_l (γλ)^l δ_{t+l}, up to the end of the episode or of the rollout (Schulman et al. 2016, eq. 16)."""
    T, N = r.reward.shape
    found = np.zeros((T, N))
    for n in range(N):
        for t in range(T):
            if not r.valid[t, n]:
                continue
            for k in range(t, T):
                nonterminal = 0.0 if r.terminated[k, n] else 1.0
                delta = float(r.reward[k, n]) + gamma * nonterminal * float(r.values[k + 1, n]) - float(r.values[k, n])
                found[t, n] += (gamma * gae_lambda) ** (k - t) * delta
                if r.terminated[k, n] or r.truncated[k, n]:
                    break
    return found


def gae_tolerance(r: Rows, gamma: float, gae_lambda: float) -> Array:
    """How far `gae` [T, N] may be from the exact sums. A term passes through three roundings in each step (γλ, product, sum)
    and five of γ and δ.
    """
    return sum_tolerance(slow_gae(r.sizes, gamma, gae_lambda), 3 * len(r.reward) + 5)


@given(rows(), st.floats(0, 1), st.floats(0, 1))
@examples(200)
def test_gae_is_the_papers_sum(r: Rows, gamma: float, gae_lambda: float) -> None:
    found = r.gae(gamma, gae_lambda)
    assert found.dtype == np.float32
    assert_within(found, slow_gae(r, gamma, gae_lambda), gae_tolerance(r, gamma, gae_lambda))


@given(rows(), st.floats(0, 1))
@examples(100)
def test_lambda_1_is_the_monte_carlo_return_less_the_value(r: Rows, gamma: float) -> None:
    T, N = r.reward.shape
    expected = np.zeros((T, N))
    for n in range(N):
        for t in range(T):
            k, g, discount = t, 0.0, 1.0
            while r.valid[t, n]:
                g += discount * r.reward[k, n]
                discount *= gamma
                if r.terminated[k, n]:
                    break
                if r.truncated[k, n] or k == T - 1:
                    g += discount * r.values[k + 1, n]
                    break
                k += 1
            expected[t, n] = g - r.values[t, n] if r.valid[t, n] else 0
    assert_within(r.gae(gamma, 1.0), expected, gae_tolerance(r, gamma, 1.0))


@given(rows(), st.floats(0, 1))
@examples(100)
def test_discounted_return_is_the_sum_of_past_rewards(r: Rows, gamma: float) -> None:
    T, N = r.reward.shape
    start = np.arange(1.0, N + 1)
    found, last = discounted_return(r.reward, r.ends, gamma, start)
    for n in range(N):
        past: list[float] = [start[n]]
        for t in range(T):
            if r.valid[t, n]:
                past.append(float(r.reward[t, n]))
                expected = sum(gamma ** (len(past) - 1 - i) * reward for i, reward in enumerate(past))
                np.testing.assert_allclose(found[t, n], expected, atol=1e-9)
            else:
                assert found[t, n] == 0
            if not r.valid[t, n] or r.terminated[t, n] or r.truncated[t, n]:
                past = []
        np.testing.assert_allclose(last[n], found[-1, n] if past else 0)


def test_discounted_return_goes_on_where_the_last_rollout_stopped() -> None:
    generator = np.random.default_rng(0)
    reward = generator.normal(size=(10, 3)).astype(np.float32)
    ends = EpisodeEnds(*lawful(generator.random((10, 3)) < 0.2, np.zeros((10, 3), bool), np.ones(3, bool)))
    earlier, later = (
        EpisodeEnds(ends.terminated[part], ends.truncated[part], ends.valid[part]) for part in (slice(4), slice(4, None))
    )
    whole, end = discounted_return(reward, ends, GAMMA, np.zeros(3))
    first, middle = discounted_return(reward[:4], earlier, GAMMA, np.zeros(3))
    second, last = discounted_return(reward[4:], later, GAMMA, middle)
    np.testing.assert_array_equal(whole, np.concatenate([first, second]))
    np.testing.assert_array_equal(end, last)
