"""Losses and what is measured of them. Pure: arrays [B] in, numbers (arrays of no dimension) out; B rows of a minibatch.

Arrays are torch's, or numpy's where the update is fused: the formula is the same. Every row given is a valid one: masking is
done where minibatches are made. A loss comes with its gradient, derived by hand (a test holds it equal to autograd's): a
small minibatch spends more time on the graph than on the arithmetic.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from protocol.arrays import Floats

A = TypeVar("A", Tensor, npt.NDArray[Any])


def _of(array: object) -> Any:
    """The library whose array it is."""
    return np if isinstance(array, np.ndarray) else torch


def _mean(array: A) -> Any:
    """Of [B]; numpy's own is several times slower where there are few."""
    return array.sum() / len(array)


def _clip(array: A, low: float, high: float) -> A:
    found: A = np.minimum(np.maximum(array, low), high) if isinstance(array, np.ndarray) else array.clamp(low, high)
    return found


def ratio(log_prob: A, before: A) -> tuple[A, A]:
    """Log ρ and ρ = π(a) / π_old(a), [B] each."""
    log_ratio = log_prob - before
    return log_ratio, _of(log_ratio).exp(log_ratio)


def standardized(advantage: A) -> A:
    """Advantages [B] less their mean, over their standard deviation; a single row has none and stays as it is."""
    if len(advantage) < 2:
        return advantage
    centred = advantage - _mean(advantage)
    std = ((centred @ centred) / (len(centred) - 1)) ** 0.5
    found: A = centred / (std + 1e-8)
    return found


def clipped_surrogate(ratio: A, advantage: A, clip_range: float) -> tuple[A, A]:
    """PPO's policy loss (Schulman et al. 2017, eq. 7), and its gradient [B] by log π(a).

    L = −E[min(ρ A, clip(ρ, 1−ε, 1+ε) A)],  ρ = π(a) / π_old(a);    ∂L/∂log π(a) = −ρ A / B where ρ A is the lesser
    """
    plain, clipped = ratio * advantage, _clip(ratio, 1 - clip_range, 1 + clip_range) * advantage
    return -_mean(_of(ratio).minimum(plain, clipped)), plain * (plain <= clipped) / -len(ratio)


def policy_gradient(log_prob: A, advantage: A) -> tuple[A, A]:
    """L = −E[A log π(a)] (Sutton et al. 1999), and its gradient [B] by log π(a)."""
    return (log_prob @ advantage) / -len(advantage), advantage / -len(advantage)


def value_loss(value: A, target: A) -> tuple[A, A]:
    """Mean squared error (as Stable-Baselines3 has it, without the half that others put before it), and its gradient [B]."""
    error = value - target
    return (error @ error) / len(error), error * (2 / len(error))


def clipped_value_loss(value: A, target: A, before: A, clip_range: float) -> tuple[A, A]:
    """The value loss of OpenAI's PPO, and its gradient [B]: moving further than this from `before` earns nothing.

    L = E[max((V − G)², (clip(V, V_old−ε, V_old+ε) − G)²)].  Stable-Baselines3 takes the second alone, which also lets go
    of a value that went too far the wrong way.
    """
    moved, error = value - before, value - target
    xp = _of(value)
    held = xp.where(abs(moved) <= clip_range, value, before + _clip(moved, -clip_range, clip_range)) - target
    plain, clipped = error * error, held * held
    return _mean(xp.maximum(plain, clipped)), error * (plain >= clipped) * (2 / len(error))


def huber_loss(error: A, weight: A) -> tuple[Any, A]:
    """E[w (½ e² where |e| ≤ 1, else |e| − ½)] of errors [B] and weights [B], and its gradient [B] by the errors."""
    held = _clip(error, -1, 1)
    weighted = weight * held
    return weighted @ (error - 0.5 * held) / len(error), weighted / len(error)


def squared_loss(error: A, weight: A) -> tuple[Any, A]:
    """E[w e²] of errors [B] and weights [B], and its gradient [B] by the errors."""
    weighted = weight * error
    return weighted @ error / len(error), weighted * (2 / len(error))


def entropy_loss(entropy: A) -> tuple[A, A]:
    """Minus the mean entropy, and its gradient [B]."""
    return -_mean(entropy), _of(entropy).full_like(entropy, -1 / len(entropy))


def approx_kl(log_ratio: A, ratio: A) -> A:
    """KL(π_old ‖ π) estimated by E[(ρ − 1) − log ρ]: unbiased, never negative (Schulman 2020, "Approximating KL")."""
    found: A = _mean(ratio - 1 - log_ratio)
    return found


def clip_fraction(ratio: A, clip_range: float) -> A:
    """The share of rows whose ratio left [1−ε, 1+ε]."""
    found: A = _of(ratio).count_nonzero(abs(ratio - 1) > clip_range) / len(ratio)
    return found


def explained_variance(value: Floats, target: Floats) -> float:
    """1 − Var(target − value) / Var(target): 1 is perfect, 0 no better than a constant; NaN where targets do not vary."""
    variance = _variance(target)
    return 1 - _variance(target - value) / variance if variance > 0 else math.nan


def _variance(array: Floats) -> float:
    centred = array - _mean(array)
    return float(centred @ centred) / len(array)
