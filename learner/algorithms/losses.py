"""The losses, in plain torch, and their metrics. Each is a pure function that takes tensors [B] and returns one number.

B is the number of rows in a minibatch. All rows are valid, because invalid ones are left out when minibatches are selected.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from millrace.protocol.arrays import Floats


def standardized(advantage: Tensor) -> Tensor:
    """Advantages [B] scaled to mean 0 and sample standard deviation 1 (with B − 1). A single row is returned unchanged."""
    if len(advantage) < 2:
        return advantage
    std, mean = torch.std_mean(advantage)
    return (advantage - mean) / (std + 1e-8)


# -------------------------------------------------------------------- losses


def clipped_surrogate(log_ratio: Tensor, advantage: Tensor, clip_range: float) -> Tensor:
    """PPO's policy loss (Schulman et al. 2017, eq. 7): L = −E[min(ρ A, clip(ρ, 1−ε, 1+ε) A)],  ρ = π(a) / π_old(a)."""
    ratio = log_ratio.exp()
    return -torch.minimum(ratio * advantage, ratio.clamp(1 - clip_range, 1 + clip_range) * advantage).mean()


def policy_gradient(log_prob: Tensor, advantage: Tensor) -> Tensor:
    """L = −E[A log π(a)] (Sutton et al. 1999)."""
    return -(log_prob * advantage).mean()


def value_loss(value: Tensor, target: Tensor) -> Tensor:
    """The mean squared error. As in Stable-Baselines3, it lacks the factor ½ that some other libraries use."""
    return (value - target).square().mean()


def clipped_value_loss(value: Tensor, target: Tensor, old_value: Tensor, clip_range: float) -> Tensor:
    """The value loss of OpenAI's PPO. Moving a value further than `clip_range` from `old_value` doesn't lower the loss.

    L = E[max((V − G)², (clip(V, V_old−ε, V_old+ε) − G)²)].  Stable-Baselines3 uses only the second square, whose gradient is
    zero even if a value has moved too far in the wrong direction.
    """
    clipped = old_value + (value - old_value).clamp(-clip_range, clip_range)
    return torch.maximum((value - target).square(), (clipped - target).square()).mean()


def entropy_loss(entropy: Tensor) -> Tensor:
    """Minus the mean entropy."""
    return -entropy.mean()


def huber_loss(error: Tensor, weight: Tensor) -> Tensor:
    """E[w h(e)] for errors e [B] and weights w [B], where h(e) is ½ e² if |e| ≤ 1, and |e| − ½ otherwise."""
    size = error.abs()
    return (weight * torch.where(size <= 1, 0.5 * error.square(), size - 0.5)).mean()


def squared_loss(error: Tensor, weight: Tensor) -> Tensor:
    """E[w e²] for errors e [B] and weights w [B]."""
    return (weight * error.square()).mean()


# -------------------------------------------------------------------- metrics


def approx_kl(log_ratio: Tensor) -> Tensor:
    """KL(π_old ‖ π), estimated as E[(ρ − 1) − log ρ], which is unbiased and never negative.

    See Schulman's article "Approximating KL Divergence" (2020).
    """
    log_ratio = log_ratio.detach()
    return (log_ratio.expm1() - log_ratio).mean()


def clip_fraction(log_ratio: Tensor, clip_range: float) -> Tensor:
    """The fraction of rows whose ratio is outside [1−ε, 1+ε]."""
    return (log_ratio.detach().expm1().abs() > clip_range).float().mean()


def explained_variance(value: Floats, target: Floats) -> float:
    """1 − Var(target − value) / Var(target): 1 is perfect, 0 is no better than a constant.

    NaN if the targets do not vary, or if there are none.
    """
    variance = _variance(target) if len(target) else 0.0
    return 1 - _variance(target - value) / variance if variance > 0 else math.nan


def _variance(array: Floats) -> float:
    centered = array - array.sum() / len(array)
    return float(centered @ centered) / len(array)
