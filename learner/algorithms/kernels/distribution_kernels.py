"""Action distributions for small networks, in numpy: log-probabilities, entropies and samples from an actor's outputs.

Rule: results and gradients equal those of `millrace.protocol.policy.torch_distributions` and autograd, except for rounding.
The kernels save 0.1 ms per minibatch of 64 rows, because autograd would need a dozen nodes. The P parameters of a
distribution are arrays [P, B], with a column for each of B rows. `forward` stores the intermediate results that `backward`
needs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.policy.exploration import LOG_SQRT_2PI
from millrace.protocol.policy.layout import LOG_STD_BOUNDS
from millrace.protocol.policy.masks import FORBIDDEN
from millrace.protocol.specs import ActionSpec

LOG_2 = math.log(2)


class EvaluatedActions:
    """A `Top` that computes log π(action), the entropy of π, and V, [B] each, from the outputs of an actor and a critic."""

    def __init__(self, distribution_kernel: DistributionKernel) -> None:
        self._distribution = distribution_kernel

    def forward(self, outputs: Sequence[Array], action: Array, mask: Bools | None) -> tuple[Array, ...]:
        """See `Top`. `action` is [B, *action]; `mask` [B, choices] is True for the choices that are allowed.

        A forbidden choice has probability p = 0. Its gradient in `backward` has the factor p, so the gradient is 0, too.
        """
        params, value = outputs
        if mask is not None:
            np.copyto(params[: mask.shape[1]], np.float32(FORBIDDEN), where=~mask.T)
        return *self._distribution.forward(params, action.reshape(len(action), -1)), value[0].copy()

    def backward(self, by_results: Sequence[Array]) -> Sequence[Array]:
        """See `Top`."""
        by_log_prob, by_entropy, by_value = by_results
        return self._distribution.backward(by_log_prob, by_entropy), by_value[None]


class SquashedSample:
    """A `Top` that samples actions a = tanh u [B, D], u = mean + std · noise, and computes their log-densities [B].

    log π(a) = Σ −½ noise² − log std − log √2π − log(1 − a²), where log(1 − a²) = 2 (log 2 − |u| − log(1 + exp(−2|u|)))
    ∂a/∂u = 1 − a²;  ∂log π(a)/∂u = 2 a;  ∂u/∂log std = std · noise
    """

    def forward(self, outputs: Sequence[Array], noise: Array) -> tuple[Array, ...]:
        """See `Top`. `noise` [B, D] is drawn from the standard normal distribution."""
        (params,) = outputs
        mean, log_std = np.split(params, 2)
        low, high = LOG_STD_BOUNDS
        self._inside = (log_std >= low) & (log_std <= high)
        log_std = np.clip(log_std, low, high)
        self._spread = np.exp(log_std) * noise.T
        latent = mean + self._spread
        height = abs(latent)
        self._action = np.tanh(latent)
        slope = 2 * (LOG_2 - height - np.log1p(np.exp(-2 * height)))
        log_prob = np.add.reduce(-0.5 * noise.T * noise.T - log_std - LOG_SQRT_2PI - slope, 0)
        return self._action.copy().T, log_prob

    def backward(self, by_results: Sequence[Array]) -> Sequence[Array]:
        """See `Top`."""
        by_action, by_log_prob = by_results
        by_latent = by_action.T * (1 - self._action * self._action) + 2 * by_log_prob * self._action
        return [np.concatenate((by_latent, (by_latent * self._spread - by_log_prob) * self._inside))]


class DistributionKernel(Protocol):
    """A distribution over actions, with the gradients of its log-probability and entropy."""

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        """Log π(action) [B] and the entropy [B], for parameters [P, B] and actions [B, k]."""
        ...

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        """∂L/∂parameters [P, B]."""
        ...


class _CategoricalKernel:
    """A categorical distribution: ∂log π(a)/∂logits = 1ₐ − p;  ∂H/∂logits = −p (log p + H)."""

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        log_p = params - np.maximum.reduce(params, 0)
        p = np.exp(log_p)
        total = np.add.reduce(p, 0)
        p /= total
        log_p -= np.log(total, out=total)
        self._log_p = log_p
        self._p = p
        self._entropy = -np.add.reduce(p * log_p, 0)
        rows = params.shape[1]
        choice = action[:, 0].astype(np.int64, copy=False)
        self._chosen = choice * rows + np.arange(rows)  # index of log π(a) in [P · B]
        return log_p.take(self._chosen), self._entropy.copy()

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        g: Array = self._log_p + self._entropy
        g *= by_entropy
        g += by_log_prob
        g *= self._p
        np.negative(g, out=g)
        g.reshape(-1)[self._chosen] += by_log_prob
        return g


class _ProductKernel:
    """A product of independent distributions: log π and H are sums, so each factor has its own gradient."""

    def __init__(self, factors: Sequence[_KernelFactor]) -> None:
        self._kernels = [factor.kernel for factor in factors]
        self._ends_of_params = np.cumsum([factor.params for factor in factors])[:-1]
        self._ends_of_actions = np.cumsum([factor.actions for factor in factors])[:-1]

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        actions = np.split(action, self._ends_of_actions, -1)
        parts = np.split(params, self._ends_of_params)
        of_factors = [kernel.forward(*each) for kernel, *each in zip(self._kernels, parts, actions, strict=True)]
        log_probs, entropies = zip(*of_factors, strict=True)
        return np.sum(log_probs, 0), np.sum(entropies, 0)

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        return np.concatenate([kernel.backward(by_log_prob, by_entropy) for kernel in self._kernels])


class _BernoulliKernel:
    """Independent bits with logits l: ∂log π/∂l = bit − σ(l);  ∂H/∂l = −l σ(l) (1 − σ(l))."""

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        self._logits = params
        self._bits = action.T.astype(params.dtype)
        self._on = 0.5 + 0.5 * np.tanh(0.5 * params)
        softplus = np.logaddexp(0, params)
        return (self._bits * params - softplus).sum(0), (softplus - params * self._on).sum(0)

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        spread = self._logits * self._on * (1 - self._on)
        by_logits: Array = by_log_prob * (self._bits - self._on) - by_entropy * spread
        return by_logits


class _GaussianKernel:
    """A normal distribution whose log σ does not depend on the state.

    With z = (a − μ) / σ: ∂log π/∂μ = z / σ;  ∂log π/∂log σ = z² − 1;  ∂H/∂log σ = 1.
    """

    def __init__(self, log_std: Array, by_log_std: Array) -> None:
        self._log_std = log_std
        self._by_log_std = by_log_std

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        self._inverse = np.exp(-self._log_std)[:, None]
        self._z = (action.T - params) * self._inverse
        self._squared = self._z * self._z
        constant = self._log_std.sum() + len(self._log_std) * LOG_SQRT_2PI
        entropy = np.full(params.shape[1], constant + 0.5 * len(self._log_std), params.dtype)
        log_prob: Array = -0.5 * np.add.reduce(self._squared, 0) - constant
        return log_prob, entropy

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        np.matmul(self._squared - 1, by_log_prob, out=self._by_log_std)
        self._by_log_std += by_entropy.sum()
        by_mean: Array = self._z * self._inverse * by_log_prob
        return by_mean


class _KernelFactor(NamedTuple):
    """One of the independent distributions of an action."""

    kernel: DistributionKernel
    params: int
    actions: int
    """how many rows of the parameters [P, B], and how many columns of the actions [B, k], belong to this factor"""


def distribution_kernel(spec: ActionSpec, log_std: Array | None, by_log_std: Array | None) -> DistributionKernel:
    """The kernel for this action space.

    For a Box, `log_std` and `by_log_std` have shape [numbers]; the kernel writes the gradient of `log_std` to `by_log_std`.
    """
    factors = [_KernelFactor(_CategoricalKernel(), size, 1) for size in spec.sizes]
    if spec.bits:
        factors.append(_KernelFactor(_BernoulliKernel(), spec.bits, spec.bits))
    if spec.numbers:
        assert log_std is not None
        assert by_log_std is not None
        factors.append(_KernelFactor(_GaussianKernel(log_std, by_log_std), spec.numbers, spec.numbers))
    return factors[0].kernel if len(factors) == 1 else _ProductKernel(factors)
