"""Log-probabilities and entropies of actions in torch, for the learner; `distributions.py` has the same in numpy."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from millrace.protocol.policy.exploration import LOG_SQRT_2PI
from millrace.protocol.specs import ActionSpec, PolicySpec

LOG_2 = math.log(2)
SQUASHED_BOUND = 0.999


def log_prob_and_entropy(spec: ActionSpec, params: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Log π(action) [B] and the entropy of π [B], for params [B, P] and actions [B, *action]; see `distributions`."""
    factors = _factors(spec)
    rows = action.reshape(len(params), -1)
    if len(factors) == 1:
        return factors[0].of(params, rows)
    parts = params.split_with_sizes([factor.params for factor in factors], -1)
    actions = rows.split_with_sizes([factor.actions for factor in factors], -1)
    log_probs, entropies = zip(
        *(factor.of(*each) for factor, *each in zip(factors, parts, actions, strict=True)), strict=True
    )
    return torch.stack(log_probs).sum(0), torch.stack(entropies).sum(0)


class _TorchFactor(NamedTuple):
    """One of the independent distributions of an action."""

    of: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    """a function from its params and actions to its log-probability and entropy"""
    params: int
    actions: int
    """number of its columns in the params [B, P], and in the actions [B, D]"""


def _factors(spec: ActionSpec) -> list[_TorchFactor]:
    factors = [_TorchFactor(_categorical, size, 1) for size in spec.sizes]
    if spec.bits:
        factors.append(_TorchFactor(_bernoulli, spec.bits, spec.bits))
    if spec.numbers:
        factors.append(_TorchFactor(_gaussian, 2 * spec.numbers, spec.numbers))
    return factors


def policy_log_prob(policy: PolicySpec, params: Tensor, action: Tensor) -> Tensor:
    """Log π(action) [B] for an actor's params [B, P] and stored actions [B, *action], whatever policy chose them.

    Squashed actions are clipped to ± `SQUASHED_BOUND`, because the density of ±1 itself is zero or infinite. A deterministic
    actor is treated as a normal distribution with standard deviation 1 around its action.
    """
    match policy.head:
        case "squashed":
            bounded = action.clamp(-SQUASHED_BOUND, SQUASHED_BOUND)
            normal, _ = log_prob_and_entropy(policy.action, params, torch.atanh(bounded))
            return normal - torch.log1p(-bounded.square()).flatten(1).sum(-1)
        case "deterministic":
            params = torch.cat((torch.tanh(params), torch.zeros_like(params)), -1)
    return log_prob_and_entropy(policy.action, params, action)[0]


def squashed_sample(params: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Actions [B, D] = tanh(mean + std · noise) and their log-densities [B], for params [B, 2 D] and normal noise [B, D].

    The log-density is computed from the noise (`exploration.SquashedGaussian`), so that it is exact even near ±1.
    """
    mean, log_std = params.chunk(2, -1)
    latent = mean + log_std.exp() * noise
    slope = 2 * (LOG_2 - latent - F.softplus(-2 * latent))  # log(1 − tanh²)
    return torch.tanh(latent), (-0.5 * noise * noise - log_std - LOG_SQRT_2PI - slope).sum(-1)


def _categorical(logits: Tensor, choice: Tensor) -> tuple[Tensor, Tensor]:
    """Log-probability and entropy for logits [B, n] and the choice [B, 1] among them."""
    log_probs = F.log_softmax(logits, -1)
    return log_probs.gather(-1, choice.long())[:, 0], -(log_probs.exp() * log_probs).sum(-1)


def _bernoulli(logits: Tensor, bits: Tensor) -> tuple[Tensor, Tensor]:
    """Log-probability and entropy for logits [B, k] and bits [B, k]."""
    softplus = F.softplus(logits)
    return (bits.to(logits.dtype) * logits - softplus).sum(-1), (softplus - logits * torch.sigmoid(logits)).sum(-1)


def _gaussian(params: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor]:
    """Log-probability and entropy for means and log standard deviations [B, 2 k], and numbers [B, k]."""
    mean, log_std = params.chunk(2, -1)
    z = (numbers - mean) * torch.exp(-log_std)
    return (-0.5 * z * z - log_std - LOG_SQRT_2PI).sum(-1), (log_std + (0.5 + LOG_SQRT_2PI)).sum(-1)
