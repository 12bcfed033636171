"""Losses and what is measured of them. Pure: tensors [B] in, numbers (tensors of no dimension) out; B rows of a minibatch.

Every row given is a valid one: masking is done where minibatches are made. A loss comes with its gradient, derived by
hand (a test holds it equal to autograd's): a small minibatch spends more time on the graph than on the arithmetic.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Floats = npt.NDArray[np.float32]


def standardized(advantage: Tensor) -> Tensor:
    """Advantages [B] less their mean, over their standard deviation; a single row has none and stays as it is."""
    if len(advantage) < 2:
        return advantage
    std, mean = torch.std_mean(advantage)
    return (advantage - mean) / (std + 1e-8)


def clipped_surrogate(ratio: Tensor, advantage: Tensor, clip_range: float) -> tuple[Tensor, Tensor]:
    """PPO's policy loss (Schulman et al. 2017, eq. 7), and its gradient [B] by log π(a).

    L = −E[min(ρ A, clip(ρ, 1−ε, 1+ε) A)],  ρ = π(a) / π_old(a);    ∂L/∂log π(a) = −ρ A / B where ρ A is the lesser
    """
    plain, clipped = ratio * advantage, ratio.clamp(1 - clip_range, 1 + clip_range) * advantage
    return -torch.minimum(plain, clipped).mean(), (plain * (plain <= clipped)).div_(-len(ratio))


def policy_gradient(log_prob: Tensor, advantage: Tensor) -> tuple[Tensor, Tensor]:
    """L = −E[A log π(a)] (Sutton et al. 1999), and its gradient [B] by log π(a)."""
    return -(log_prob * advantage).mean(), advantage / -len(advantage)


def value_loss(value: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Mean squared error (as Stable-Baselines3 has it, without the half that others put before it), and its gradient [B]."""
    error = value - target
    return (error * error).mean(), error * (2 / len(error))


def clipped_value_loss(value: Tensor, target: Tensor, before: Tensor, clip_range: float) -> tuple[Tensor, Tensor]:
    """The value loss of OpenAI's PPO, and its gradient [B]: moving further than this from `before` earns nothing.

    L = E[max((V − G)², (clip(V, V_old−ε, V_old+ε) − G)²)].  Stable-Baselines3 takes the second alone, which also lets go
    of a value that went too far the wrong way.
    """
    moved, error = value - before, value - target
    held = torch.where(moved.abs() <= clip_range, value, before + moved.clamp(-clip_range, clip_range)) - target
    plain, clipped = error * error, held * held
    return torch.maximum(plain, clipped).mean(), error * (plain >= clipped) * (2 / len(error))


def entropy_loss(entropy: Tensor) -> tuple[Tensor, Tensor]:
    """Minus the mean entropy, and its gradient [B]."""
    return -entropy.mean(), torch.full_like(entropy, -1 / len(entropy))


def approx_kl(log_ratio: Tensor, ratio: Tensor) -> Tensor:
    """KL(π_old ‖ π) estimated by E[(ρ − 1) − log ρ]: unbiased, never negative (Schulman 2020, "Approximating KL")."""
    return (ratio - 1 - log_ratio).mean()


def clip_fraction(ratio: Tensor, clip_range: float) -> Tensor:
    """The share of rows whose ratio left [1−ε, 1+ε]."""
    return ((ratio - 1).abs() > clip_range).float().mean()


def explained_variance(value: Floats, target: Floats) -> float:
    """1 − Var(target − value) / Var(target): 1 is perfect, 0 no better than a constant; NaN where targets do not vary."""
    variance = float(np.var(target))
    return 1 - float(np.var(target - value)) / variance if variance > 0 else math.nan
