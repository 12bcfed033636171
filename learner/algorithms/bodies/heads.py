"""Critics that predict a distribution of returns, as quantiles (TQC, Rainbow) or as category probabilities (C51, XQC).

All functions are pure. Arrays are [..., B, O]: rows, then outputs. The outputs of a quantile critic are the quantiles at the
fractions (2 i + 1) / (2 O), for i from 0 to O − 1. The outputs of a categorical critic are the logits of O returns, the
atoms, which are equally spaced between two bounds.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def lowest(quantiles: Tensor, kept: int) -> Tensor:
    """The lowest quantiles [B, kept] of K critics [K, B, O], pooled, in ascending order (Kuznetsov et al. 2020)."""
    together = quantiles.transpose(0, 1).flatten(1)
    return together.sort(-1).values[:, :kept]


def quantile_huber(quantiles: Tensor, targets: Tensor) -> Tensor:
    """The loss [K, B] of quantiles [K, B, O] for target returns [B, J] (Dabney et al. 2018).

    Mean over i and j of |τᵢ − [u < 0]| · H(u), where u = yⱼ − qᵢ, and H is Huber's loss, quadratic up to 1.
    """
    count = quantiles.shape[-1]
    fractions = (torch.arange(count, dtype=quantiles.dtype, device=quantiles.device) + 0.5) / count
    error = targets.unsqueeze(-2) - quantiles.unsqueeze(-1)  # [K, B, O, J]
    slope = torch.where(error < 0, 1 - fractions[:, None], fractions[:, None])
    return (slope * F.huber_loss(error, torch.zeros_like(error), reduction="none")).mean((-2, -1))


class Categories:
    """A categorical distribution over O equally spaced returns, the atoms, from −bound to bound."""

    def __init__(self, count: int, bound: float, device: str | torch.device = "cpu") -> None:
        self.bound = bound
        self.step = 2 * bound / (count - 1)
        self.atoms = torch.linspace(-bound, bound, count, device=device)  # [O]

    def mean(self, logits: Tensor) -> Tensor:
        """The expected returns [..., B] under logits [..., B, O]."""
        return logits.softmax(-1) @ self.atoms.to(logits.dtype)

    def shifted(self, probabilities: Tensor, reward: Tensor, discount: Tensor) -> Tensor:
        """The distribution [B, O] of reward + discount · Z on the same atoms, where Z has these probabilities [B, O].

        The probability of a return between two atoms is divided between them by linear interpolation; a return beyond a
        bound counts as the bound (Bellemare et al. 2017).
        """
        returns = reward[:, None] + discount[:, None] * self.atoms.to(reward.dtype)
        position = (returns.clamp(-self.bound, self.bound) + self.bound) / self.step
        lower = position.floor().clamp(max=len(self.atoms) - 2)
        upper_share = position - lower
        projected = torch.zeros_like(probabilities)
        projected.scatter_add_(-1, lower.long(), probabilities * (1 - upper_share))
        return projected.scatter_add_(-1, lower.long() + 1, probabilities * upper_share)

    @staticmethod
    def cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
        """−Σ target · log softmax(logits) [..., B], for logits [..., B, O] and a target [B, O]."""
        return -(target * F.log_softmax(logits, -1)).sum(-1)
