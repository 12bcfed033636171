"""Scales rewards so that values stay within the categories of a distributional critic (XQC).

Rule: rewards are divided by the standard deviation of the discounted return, or by more if necessary, so that neither the
discounted return so far nor the value of continuing after a truncated episode exceeds the bound. A truncated episode would
have continued. If its rewards stayed at their discounted mean, its value would be this mean divided by 1 − γ. With a short
time limit, this value is several times the discounted return, and without this rule all actions would seem to be worth the
bound. The last reward doesn't count, because in some environments it includes a penalty for the truncation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from millrace.learner.algorithms.returns import EpisodeEnds, discounted_return
from millrace.learner.algorithms.running_statistics import RewardScaler, continued
from millrace.protocol.arrays import Bools, Doubles, Floats


class BoundedReturns(RewardScaler):
    """Divides rewards so that values lie between ± a bound."""

    def __init__(self, gamma: float, bound: float) -> None:
        super().__init__(gamma)
        self._bound = bound
        self._largest = 0.0  # the largest absolute value so far, in units of unscaled rewards
        self._weights: dict[int, Doubles] = {}  # by lane, Σ γⁱ over the steps of each env copy's episode so far

    def scaled(self, reward: Floats) -> Floats:
        """These rewards, float32, divided by the standard deviation, or by more if values would exceed the bound."""
        divided: Floats = (reward / max(self.std, self._largest / self._bound)).astype(np.float32)
        return divided

    def may_last(self, reward: Floats, discount: Floats) -> None:
        """Record that such rewards may be earned forever. With γ = 1, do nothing.

        `reward` [B]: Σ γⁱ r over k steps. `discount` [B]: γᵏ; 0 if the episode terminated, because the rewards then end.
        """
        if self._gamma < 1:  # the same sum again after k steps, again and again, is worth its (1 + γᵏ + γ²ᵏ + …)-fold
            value = reward / (1 - np.minimum(discount, self._gamma, dtype=np.float64))  # float32 may round γᵏ up to 1
            self._largest = max(self._largest, float(abs(value).max(initial=0)))

    def counted(self, returns: Doubles, reward: Floats, ends: EpisodeEnds, lane: int, fresh: Bools) -> None:
        """See `RewardScaler`."""
        self._largest = max(self._largest, float(abs(returns[ends.valid]).max(initial=0)))
        if self._gamma == 1:
            return
        ones = np.ones_like(reward)
        weights, self._weights[lane] = discounted_return(ones, ends, self._gamma, continued(self._weights, lane, fresh))
        longer = ends.truncated & ends.valid & (weights > 1)  # episodes of more than one step
        mean = (returns - reward)[longer] / (weights - 1)[longer]
        self._largest = max(self._largest, float(abs(mean).max(initial=0)) / (1 - self._gamma))

    def state_dict(self) -> dict[str, Any]:
        """A copy of the state, as tensors and numbers."""
        weights = {lane: torch.tensor(weights) for lane, weights in self._weights.items()}
        return super().state_dict() | {"largest": self._largest, "weights": weights}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        super().load_state_dict(state)
        self._largest = float(state["largest"])
        self._weights = {int(lane): weights.numpy().copy() for lane, weights in state["weights"].items()}
