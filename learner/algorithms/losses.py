"""The losses, for autograd, and metrics about them. Pure: tensors [B] in, tensors of no dimension out.

B is the number of rows of a minibatch. All of them are valid: rows are masked where minibatches are selected.
`kernels.loss_gradients` has the same losses with gradients derived by hand. It also uses `ratio`, `standardized`,
`approx_kl` and `clip_fraction`, so these functions take numpy arrays too.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from protocol.arrays import Floats

TensorOrArray = TypeVar("TensorOrArray", Tensor, npt.NDArray[Any])


def library(array: object) -> Any:
    """Numpy for a numpy array, else torch."""
    return np if isinstance(array, np.ndarray) else torch


def mean(array: TensorOrArray) -> Any:
    """The mean of [B]. numpy's own `mean` is several times slower on short arrays."""
    return array.sum() / len(array)


# -------------------------------------------------------------------- of tensors and numpy arrays


def ratio(log_prob_now: TensorOrArray, log_prob: TensorOrArray) -> tuple[TensorOrArray, TensorOrArray]:
    """Log ρ and ρ = π(a) / π_old(a), [B] each."""
    log_ratio = log_prob_now - log_prob
    return log_ratio, library(log_ratio).exp(log_ratio)


def standardized(advantage: TensorOrArray) -> TensorOrArray:
    """Advantages [B] with mean 0 and standard deviation 1. A single row has no standard deviation and stays as it is."""
    if len(advantage) < 2:
        return advantage
    centered = advantage - mean(advantage)
    std = ((centered @ centered) / (len(centered) - 1)) ** 0.5
    found: TensorOrArray = centered / (std + 1e-8)
    return found


def approx_kl(log_ratio: TensorOrArray, ratio: TensorOrArray) -> TensorOrArray:
    """KL(π_old ‖ π) estimated by E[(ρ − 1) − log ρ]: unbiased, never negative (Schulman 2020, "Approximating KL")."""
    found: TensorOrArray = mean(ratio - 1 - log_ratio)
    return found


def clip_fraction(ratio: TensorOrArray, clip_range: float) -> TensorOrArray:
    """The fraction of rows whose ratio is outside [1−ε, 1+ε]."""
    found: TensorOrArray = library(ratio).count_nonzero(abs(ratio - 1) > clip_range) / len(ratio)
    return found


# -------------------------------------------------------------------- losses


def clipped_surrogate(ratio: Tensor, advantage: Tensor, clip_range: float) -> Tensor:
    """PPO's policy loss (Schulman et al. 2017, eq. 7): L = −E[min(ρ A, clip(ρ, 1−ε, 1+ε) A)],  ρ = π(a) / π_old(a)."""
    return -torch.minimum(ratio * advantage, ratio.clamp(1 - clip_range, 1 + clip_range) * advantage).mean()


def policy_gradient(log_prob: Tensor, advantage: Tensor) -> Tensor:
    """L = −E[A log π(a)] (Sutton et al. 1999)."""
    return -(log_prob * advantage).mean()


def value_loss(value: Tensor, target: Tensor) -> Tensor:
    """Mean squared error, as in Stable-Baselines3: without the factor ½ that other libraries have."""
    return (value - target).square().mean()


def clipped_value_loss(value: Tensor, target: Tensor, old_value: Tensor, clip_range: float) -> Tensor:
    """The value loss of OpenAI's PPO: moving further than `clip_range` from `old_value` does not lower it.

    L = E[max((V − G)², (clip(V, V_old−ε, V_old+ε) − G)²)].  Stable-Baselines3 takes only the second square, which also has
    no gradient for a value that moved too far in the wrong direction.
    """
    clipped = old_value + (value - old_value).clamp(-clip_range, clip_range)
    return torch.maximum((value - target).square(), (clipped - target).square()).mean()


def entropy_loss(entropy: Tensor) -> Tensor:
    """Minus the mean entropy."""
    return -entropy.mean()


def huber_loss(error: Tensor, weight: Tensor) -> Tensor:
    """E[w (½ e² where |e| ≤ 1, else |e| − ½)] of errors [B] and weights [B]."""
    size = error.abs()
    return (weight * torch.where(size <= 1, 0.5 * error.square(), size - 0.5)).mean()


def squared_loss(error: Tensor, weight: Tensor) -> Tensor:
    """E[w e²] of errors [B] and weights [B]."""
    return (weight * error.square()).mean()


# -------------------------------------------------------------------- numpy


def explained_variance(value: Floats, target: Floats) -> float:
    """1 − Var(target − value) / Var(target): 1 is perfect, 0 is no better than a constant.

    NaN where the targets do not vary, or where there are none.
    """
    variance = _variance(target) if len(target) else 0.0
    return 1 - _variance(target - value) / variance if variance > 0 else math.nan


def _variance(array: Floats) -> float:
    centered = array - mean(array)
    return float(centered @ centered) / len(array)
