"""Returns and advantages. Pure: arrays [T, N] in, arrays [T, N] out; T steps of N env copies.

Every function keeps the law of a row (`protocol.rollout`): row t bootstraps from `values[t+1]`, the value of `obs[t+1]`,
which is the true final observation of an episode that the clock ended. Nothing flows across an end, and a row that is
not valid is zero and touches no other, whatever stands in it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float32]


def gae(
    reward: Floats,
    values: Floats,
    terminated: Bools,
    truncated: Bools,
    valid: Bools,
    gamma: float,
    gae_lambda: float,
) -> Floats:
    """Generalised advantage estimates [T, N] float32 (Schulman et al. 2016); reward [T, N], values [T+1, N].

        δₜ = rₜ + γ V(sₜ₊₁) [not terminated] − V(sₜ)
        Aₜ = δₜ + γλ Aₜ₊₁ [neither terminated nor truncated]

    The returns to fit V to are A + values[:-1].
    """
    T, N = reward.shape
    assert values.shape == (T + 1, N), f"values expected {(T + 1, N)}, got {values.shape}"
    bootstrap = np.where(terminated, np.float32(0), values[1:])
    advantage = np.where(valid, reward + np.float32(gamma) * bootstrap - values[:-1], np.float32(0))
    carried = (valid & ~(terminated | truncated)) * np.float32(gamma * gae_lambda)
    for t in range(T - 2, -1, -1):
        advantage[t] += carried[t] * advantage[t + 1]
    return advantage


def discounted_return(
    reward: Floats,
    ended: Bools,
    valid: Bools,
    gamma: float,
    start: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """What reward normalisation measures: the discounted sum of the *past* rewards of this episode.

        Gₜ = rₜ + γ Gₜ₋₁ [the same episode]

    `start` [N] is G of the row before the first, 0 where an episode begins. Returns G [T, N] float64 (0 where the row is
    not valid) and what to start the next rollout of these copies with [N].
    """
    found = np.zeros(reward.shape)
    last = start
    for t in range(len(reward)):
        found[t] = np.where(valid[t], reward[t] + gamma * last, 0)
        last = np.where(ended[t], 0, found[t])
    return found, last
