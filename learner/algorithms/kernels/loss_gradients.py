"""The losses of `learner.algorithms.losses` with their gradients derived by hand: no autograd graph.

For a small minibatch, autograd's graph takes more time than the arithmetic. Pure: each function takes arrays [B] and returns
the loss, an array of no dimension, and its gradient [B]. Arrays are torch tensors, or numpy arrays if the network is
evaluated in numpy (`kernels.fused`). The formulas are the same. Tests compare each gradient with autograd's.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from learner.algorithms.losses import TensorOrArray as A
from learner.algorithms.losses import approx_kl, clip_fraction, library, mean, ratio
from learner.algorithms.minibatches import LossInput


class OutputGradients(NamedTuple):
    """∂L/∂output for each output of an actor-critic network, [B] each."""

    by_log_prob: Any
    by_entropy: Any
    by_value: Any


Numbers = dict[str, Any]  # metrics of a minibatch by name: arrays of no dimension

# -------------------------------------------------------------------- whole losses of an actor-critic


def policy_gradient_and_value(rows: LossInput, *, ent_coef: float, vf_coef: float) -> tuple[Numbers, OutputGradients]:
    """L = −E[A log π(a)] + vf_coef E[(V − target)²] − ent_coef E[H(π)]."""
    policy_loss, by_log_prob = policy_gradient(rows.log_prob_now, rows.advantage)
    value_part, by_value = value_loss(rows.value, rows.target)
    entropy_part, by_entropy = entropy_loss(rows.entropy)
    by_entropy *= ent_coef
    by_value *= vf_coef
    numbers = {"policy_gradient_loss": policy_loss, "value_loss": value_part, "entropy_loss": entropy_part}
    return numbers, OutputGradients(by_log_prob, by_entropy, by_value)


def ppo(
    rows: LossInput, *, clip_range: float, clip_range_vf: float | None, ent_coef: float, vf_coef: float
) -> tuple[Numbers, OutputGradients]:
    """PPO's loss; see `PPO.loss`."""
    log_ratio, rho = ratio(rows.log_prob_now, rows.log_prob)
    policy_loss, by_log_prob = clipped_surrogate(rho, rows.advantage, clip_range)
    if clip_range_vf is None:
        value_part, by_value = value_loss(rows.value, rows.target)
    else:
        old_value = rows.target - rows.raw_advantage
        value_part, by_value = clipped_value_loss(rows.value, rows.target, old_value, clip_range_vf)
    entropy_part, by_entropy = entropy_loss(rows.entropy)
    by_entropy *= ent_coef
    by_value *= vf_coef
    numbers = {
        "policy_gradient_loss": policy_loss,
        "value_loss": value_part,
        "entropy_loss": entropy_part,
        "approx_kl": approx_kl(log_ratio, rho),
        "clip_fraction": clip_fraction(rho, clip_range),
    }
    return numbers, OutputGradients(by_log_prob, by_entropy, by_value)


# -------------------------------------------------------------------- single losses


def clipped_surrogate(ratio: A, advantage: A, clip_range: float) -> tuple[A, A]:
    """PPO's policy loss and its gradient with respect to log π(a).

    The gradient is −ρ A / B if ρ A is the smaller of the two terms, else 0.
    """
    plain, clipped = ratio * advantage, _clip(ratio, 1 - clip_range, 1 + clip_range) * advantage
    return -mean(library(ratio).minimum(plain, clipped)), plain * (plain <= clipped) / -len(ratio)


def policy_gradient(log_prob: A, advantage: A) -> tuple[A, A]:
    """−E[A log π(a)] and its gradient with respect to log π(a)."""
    return (log_prob @ advantage) / -len(advantage), advantage / -len(advantage)


def value_loss(value: A, target: A) -> tuple[A, A]:
    """The mean squared error and its gradient with respect to the value."""
    error = value - target
    return (error @ error) / len(error), error * (2 / len(error))


def clipped_value_loss(value: A, target: A, old_value: A, clip_range: float) -> tuple[A, A]:
    """The clipped value loss and its gradient with respect to the value."""
    moved, error = value - old_value, value - target
    xp = library(value)
    clipped_value = xp.where(abs(moved) <= clip_range, value, old_value + _clip(moved, -clip_range, clip_range))
    clipped_error = clipped_value - target
    plain, clipped = error * error, clipped_error * clipped_error
    return mean(xp.maximum(plain, clipped)), error * (plain >= clipped) * (2 / len(error))


def entropy_loss(entropy: A) -> tuple[A, A]:
    """Minus the mean entropy and its gradient with respect to the entropy."""
    return -mean(entropy), library(entropy).full_like(entropy, -1 / len(entropy))


def huber_loss(error: A, weight: A) -> tuple[Any, A]:
    """The weighted Huber loss and its gradient with respect to the error."""
    clipped = _clip(error, -1, 1)
    weighted = weight * clipped
    return weighted @ (error - 0.5 * clipped) / len(error), weighted / len(error)


def squared_loss(error: A, weight: A) -> tuple[Any, A]:
    """The weighted squared loss and its gradient with respect to the error."""
    weighted = weight * error
    return weighted @ error / len(error), weighted * (2 / len(error))


def _clip(array: A, low: float, high: float) -> A:
    found: A = np.minimum(np.maximum(array, low), high) if isinstance(array, np.ndarray) else array.clamp(low, high)
    return found
