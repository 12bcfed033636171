"""Returns and advantages, as pure functions of arrays [T, N]: T steps of N env copies.

The replay buffer that draws single rows computes n-step returns itself, because it follows rows from slot to slot
(`replay/replay_buffer.py`).

Every function follows the row format (`millrace.protocol.rollout`): row t bootstraps from `values[t+1]`, the value of
`obs[t+1]`. Where an episode was truncated, `obs[t+1]` is its true final observation. No function adds rewards or values
across the end of an episode. A row that is not valid gives zero and does not affect other rows, whatever it contains. A
value that a computation carries from row to row, in either direction, passes through such a row unchanged.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from millrace.protocol.arrays import Bools, Doubles, Floats, Ints
from millrace.protocol.rollout import Batch


class EpisodeEnds(NamedTuple):
    """Where episodes end in a batch, and which of its rows are steps of an episode, as arrays [T, N]."""

    terminated: Bools
    truncated: Bools
    valid: Bools
    with_seats: bool = False
    """Whether an invalid row may lie between two rows of an episode. If not, it always follows the end of an episode."""

    @classmethod
    def of(cls, batch: Batch) -> EpisodeEnds:
        """The episode ends of a batch, without copying its arrays."""
        return cls(batch.terminated, batch.truncated, batch.valid, batch.resets is not None)

    @property
    def ended(self) -> Bools:
        """[T, N] True where the episode was terminated or truncated."""
        return self.terminated | self.truncated

    def columns(self, at: slice) -> EpisodeEnds:
        """The episode ends of some env copies (columns of [T, N])."""
        return EpisodeEnds(self.terminated[:, at], self.truncated[:, at], self.valid[:, at], self.with_seats)


def gae(reward: Floats, values: Floats, ends: EpisodeEnds, gamma: float, gae_lambda: float) -> Floats:
    """Generalized advantage estimates [T, N] float32 (Schulman et al. 2016), from reward [T, N] and values [T+1, N].

        δₜ = rₜ + γ V(sₜ₊₁) [not terminated] − V(sₜ)
        Aₜ = δₜ + γλ Aₜ₊₁ [neither terminated nor truncated]

    The targets of V are A + values[:-1]. Where an episode is truncated, V(sₜ₊₁) is the value of its final observation.
    """
    T, N = reward.shape
    assert values.shape == (T + 1, N), f"values: expected {(T + 1, N)}, got {values.shape}"
    bootstrap = np.where(ends.terminated, np.float32(0), values[1:])
    advantage = np.where(ends.valid, reward + np.float32(gamma) * bootstrap - values[:-1], np.float32(0))
    carried = (ends.valid & ~ends.ended) * np.float32(gamma * gae_lambda)
    following = advantage[-1]  # the advantage of the next valid row; 0 if there is none
    for t in range(T - 2, -1, -1):
        advantage[t] += carried[t] * following
        following = np.where(ends.valid[t], advantage[t], following) if ends.with_seats else advantage[t]
    return advantage


def vtrace(
    reward: Floats,
    values: Floats,
    log_ratio: Floats,
    ends: EpisodeEnds,
    gamma: float,
    vtrace_lambda: float = 1.0,
    rho_bar: float = 1.0,
    c_bar: float = 1.0,
) -> tuple[Floats, Floats]:
    """V-trace targets vs and policy-gradient advantages A, [T, N] float32 (Espeholt et al. 2018, eq. 1 and section 4.2).

        ρₜ = min(ρ̄, π(aₜ) / μ(aₜ)),  cₜ = λ min(c̄, π(aₜ) / μ(aₜ));  `log_ratio` [T, N] is log π(aₜ) − log μ(aₜ)
        δₜ = ρₜ (rₜ + γ V(sₜ₊₁) [not terminated] − V(sₜ))
        vsₜ = V(sₜ) + δₜ + γ cₜ (vsₜ₊₁ − V(sₜ₊₁)) [neither terminated nor truncated]
        Aₜ = ρₜ (rₜ + γ v′ₜ₊₁ [not terminated] − V(sₜ)),  v′ = λ vs + (1−λ) V within the episode, V where it was cut

    With λ = 1, as in the paper, v′ is vs; with π = μ, A is `gae` and vs is A + V, for any λ.
    """
    T, N = reward.shape
    assert values.shape == (T + 1, N), f"values: expected {(T + 1, N)}, got {values.shape}"
    zero, discount, mix = np.float32(0), np.float32(gamma), np.float32(vtrace_lambda)
    log_ratio = np.where(ends.valid, log_ratio, zero)
    rho = np.exp(np.minimum(log_ratio, np.float32(math.log(rho_bar))))  # clipped first, so that exp cannot overflow
    c = np.exp(np.minimum(log_ratio, np.float32(math.log(c_bar))))
    bootstrap = np.where(ends.terminated, zero, values[1:])
    delta = np.where(ends.valid, rho * (reward + discount * bootstrap - values[:-1]), zero)
    goes_on = ends.valid & ~ends.ended
    goes_on[-1] = False
    ahead = np.zeros_like(delta)  # vs − V of the next row, where the episode continues in this rollout
    vs_minus_v = delta.copy()
    following = vs_minus_v[-1]  # vs − V of the next valid row
    for t in range(T - 2, -1, -1):
        ahead[t] = np.where(goes_on[t], following, zero)
        vs_minus_v[t] += discount * mix * c[t] * ahead[t]
        following = np.where(ends.valid[t], vs_minus_v[t], following) if ends.with_seats else vs_minus_v[t]
    target = np.where(ends.valid, vs_minus_v + values[:-1], zero)
    return target, delta + rho * discount * mix * ahead


class NStepReturns(NamedTuple):
    """The returns of the next k steps of each row, as arrays [T, N].

    k is `n_step`, or less if the episode or the rollout ends sooner. Rows that are not valid hold meaningless numbers.
    """

    reward: Doubles
    """Σ γⁱ r over the k steps"""
    discount: Doubles
    """γᵏ; 0 where the episode terminated"""
    last: Ints
    """The step of the observation that follows the k steps, at most T. Where the episode terminated, the step of the last
    row, because nothing is learned from the observation after it."""


def n_step_returns(reward: Floats, ends: EpisodeEnds, gamma: float, n_step: int) -> NStepReturns:
    """For each row, the discounted sum of up to `n_step` rewards: its own and those of the episode's next valid rows.

    `reward` is [T, N].
    """
    T, N = reward.shape
    following = np.full((T, N), T)  # [T, N] the step of the next valid row of the same episode; T if there is none
    next_valid = np.full(N, T)
    for t in range(T - 1, -1, -1):
        following[t] = np.where(ends.ended[t], T, next_valid)
        next_valid = np.where(ends.valid[t], t, next_valid if ends.with_seats else T)
    column = np.arange(N)
    at = np.repeat(np.arange(T)[:, None], N, axis=1)
    total = reward.astype(np.float64)
    discount = np.where(ends.terminated, 0.0, gamma)
    for _ in range(n_step - 1):
        next_row = following[at, column]
        going = next_row < T
        at = np.where(going, next_row, at)
        total += np.where(going, discount * reward[at, column], 0)
        discount = np.where(going, discount * gamma * ~ends.terminated[at, column], discount)
    return NStepReturns(total, discount, at + ~ends.terminated[at, column])


def complete(ends: EpisodeEnds) -> Bools:
    """[T, N] True for valid rows whose episode ends within the rollout, so all later rewards of the episode are known."""
    return np.asarray(np.logical_or.accumulate((ends.ended & ends.valid)[::-1])[::-1] & ends.valid)


def discounted_return(reward: Floats, ends: EpisodeEnds, gamma: float, start: Doubles) -> tuple[Doubles, Doubles]:
    """The discounted sum of the *past* rewards in each row's episode. The spread of these sums sets the scale of rewards.

        Gₜ = rₜ + γ Gₜ₋₁ [the same episode]

    `start` [N] is G of the row before the first one, or 0 where an episode begins. Returns G [T, N] float64 (0 where the row
    is not valid), and the `start` [N] for these copies' next rollout.
    """
    returns = np.zeros(reward.shape)
    last, ended = start, ends.ended
    for t in range(len(reward)):
        returns[t] = np.where(ends.valid[t], reward[t] + gamma * last, 0)
        passes = ~ends.valid[t] & ends.with_seats
        last = np.where(passes, last, np.where(ended[t], 0, returns[t]))
    return returns, last
