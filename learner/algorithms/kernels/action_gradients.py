"""Log-probabilities and entropies of actions, and their gradients derived by hand, in numpy.

Rule: results equal those of `log_prob_and_entropy` (`protocol.policy.torch_distributions`) and autograd, except for
rounding. Parameters are [P, B], a column for each of B rows; actions are [B, k]. `forward` keeps what `backward` needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from protocol.arrays import Array
from protocol.policy.distributions import LOG_SQRT_2PI
from protocol.specs import ActionSpec


class ActionGradients(Protocol):
    """A distribution over actions with the gradients of its log-probability and entropy."""

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        """Parameters [P, B] and actions [B, k] -> log π(action) [B], entropy [B]."""
        ...

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        """∂L/∂parameters [P, B]."""
        ...


class _Categorical:
    """∂log π(a)/∂logits = 1ₐ − p;  ∂H/∂logits = −p (log p + H)."""

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        log_p = params - np.maximum.reduce(params, 0)
        p = np.exp(log_p)
        total = np.add.reduce(p, 0)
        p /= total
        log_p -= np.log(total, out=total)
        self._log_p, self._p = log_p, p
        self._entropy = -np.add.reduce(p * log_p, 0)
        rows = params.shape[1]
        self._chosen = action[:, 0] * rows + np.arange(rows)  # index of log π(a) in [P · B]
        return log_p.take(self._chosen), self._entropy

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        g: Array = self._log_p + self._entropy
        g *= by_entropy
        g += by_log_prob
        g *= self._p
        np.negative(g, out=g)
        g.reshape(-1)[self._chosen] += by_log_prob
        return g


class _MultiCategorical:
    """A product of independent categorical distributions: log π and H are sums, so each part has its own gradient."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self._ends = np.cumsum(sizes)[:-1]
        self._parts = [_Categorical() for _ in sizes]

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        choices = np.split(action, action.shape[1], -1)
        logits = np.split(params, self._ends)
        found = [part.forward(*each) for part, *each in zip(self._parts, logits, choices, strict=True)]
        log_probs, entropies = zip(*found, strict=True)
        return np.sum(log_probs, 0), np.sum(entropies, 0)

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        return np.concatenate([part.backward(by_log_prob, by_entropy) for part in self._parts])


class _Bernoulli:
    """Independent bits with logits l: ∂log π/∂l = bit − σ(l);  ∂H/∂l = −l σ(l) (1 − σ(l))."""

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        self._logits, self._bits = params, action.T.astype(params.dtype)
        self._on = 0.5 + 0.5 * np.tanh(0.5 * params)
        softplus = np.logaddexp(0, params)
        return (self._bits * params - softplus).sum(0), (softplus - params * self._on).sum(0)

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        spread = self._logits * self._on * (1 - self._on)
        found: Array = by_log_prob * (self._bits - self._on) - by_entropy * spread
        return found


class _Gaussian:
    """z = (a − μ) / σ: ∂log π/∂μ = z / σ;  ∂log π/∂log σ = z² − 1;  ∂H/∂log σ = 1. log σ does not depend on the state."""

    def __init__(self, log_std: Array, log_std_grad: Array) -> None:
        self._log_std, self._log_std_grad = log_std, log_std_grad

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        self._inverse = np.exp(-self._log_std)[:, None]
        self._z = (action.T - params) * self._inverse
        self._squared = self._z * self._z
        constant = self._log_std.sum() + len(self._log_std) * LOG_SQRT_2PI
        entropy = np.full(params.shape[1], constant + 0.5 * len(self._log_std), params.dtype)
        log_prob: Array = -0.5 * np.add.reduce(self._squared, 0) - constant
        return log_prob, entropy

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        np.matmul(self._squared - 1, by_log_prob, out=self._log_std_grad)
        self._log_std_grad += by_entropy.sum()
        self._z *= self._inverse
        self._z *= by_log_prob
        found: Array = self._z
        return found


def action_gradients(spec: ActionSpec, log_std: Array | None, log_std_grad: Array | None) -> ActionGradients:
    """The distribution of this action space. `log_std`, `log_std_grad`: [k], for Box actions only."""
    match spec.kind:
        case "discrete":
            return _Categorical()
        case "multidiscrete":
            return _MultiCategorical(spec.sizes)
        case "multibinary":
            return _Bernoulli()
        case "box":
            assert log_std is not None
            assert log_std_grad is not None
            return _Gaussian(log_std, log_std_grad)
    raise ValueError(spec.kind)
