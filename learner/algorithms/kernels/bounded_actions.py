"""Actions in [-1, 1] of SAC and TD3, their log-densities and values, and the gradients of these derived by hand.

Rule: results equal those of `protocol.policy.torch_distributions.squashed_sample` and autograd, except for rounding. Arrays
are torch tensors or numpy arrays.
"""

from __future__ import annotations

import math

from learner.algorithms.losses import TensorOrArray, library
from protocol.policy.distributions import LOG_SQRT_2PI

LOG_2 = math.log(2)


class SquashedSample:
    """One action tanh(mean + std · noise) for each of B rows, and its log-density.

    With u = mean + std · noise and a = tanh u:
    log π(a) = Σ −½ noise² − log std − log √2π − log(1 − a²), where log(1 − a²) = 2 (log 2 − |u| − log(1 + exp(−2|u|)))
    ∂a/∂u = 1 − a²;  ∂log π(a)/∂u = 2 a;  ∂u/∂log std = std · noise
    """

    def __init__(self, params: TensorOrArray, noise: TensorOrArray) -> None:
        """`params` [B, 2 D]: mean, then log std. `noise` [B, D]: normal."""
        of = library(params)
        size = params.shape[1] // 2
        log_std = params[:, size:]
        self._spread = of.exp(log_std) * noise
        latent = params[:, :size] + self._spread
        self.action = of.tanh(latent)
        """[B, D]"""
        height = abs(latent)
        slope = 2 * (LOG_2 - height - of.log1p(of.exp(-2 * height)))
        self.log_prob = (-0.5 * noise * noise - log_std - LOG_SQRT_2PI - slope).sum(-1)
        """[B]"""

    def backward(self, by_action: TensorOrArray, by_log_prob: float) -> TensorOrArray:
        """The loss's gradient [B, 2 D] by `params`, from that by the actions [B, D] and by every log-density (a number)."""
        by_latent = by_action * (1 - self.action * self.action) + 2 * by_log_prob * self.action
        found: TensorOrArray = library(by_latent).concatenate((by_latent, by_latent * self._spread - by_log_prob), 1)
        return found


class DeterministicAction:
    """The action tanh(output) for each of B rows."""

    def __init__(self, output: TensorOrArray) -> None:
        """`output` [B, D]: the actor's."""
        self.action = library(output).tanh(output)
        """[B, D]"""

    def backward(self, by_action: TensorOrArray) -> TensorOrArray:
        """The loss's gradient [B, D] by `output`, from that by the actions [B, D]."""
        found: TensorOrArray = by_action * (1 - self.action * self.action)
        return found


def smaller(values: TensorOrArray) -> TensorOrArray:
    """The smaller one [B] of two values [2, B]."""
    found: TensorOrArray = library(values).minimum(values[0], values[1])
    return found


def which_is_smaller(values: TensorOrArray) -> TensorOrArray:
    """Which of two values [2, B] is the smaller one: booleans [2, B], one of them true for each row."""
    first = values[0] <= values[1]
    found: TensorOrArray = library(values).stack((first, ~first))
    return found
