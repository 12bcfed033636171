"""Critics of distributions: losses by loops, targets by loops, and a chain whose return distribution is known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.optim import Optimizer

from millrace.learner.algorithms.bodies.autograd_leaves import trainable
from millrace.learner.algorithms.bodies.heads import Categories, lowest, quantile_huber
from millrace.learner.algorithms.kernels.optimizer_step import make_optimizer, take_step
from millrace.protocol.arrays import Doubles

ROUNDING: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-12}


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def distributions(*shape: int, seed: int = 0) -> Tensor:
    return normal(*shape, seed=seed).softmax(-1)


# -------------------------------------------------------------------- quantiles


def test_the_quantile_huber_loss_is_that_of_the_formula() -> None:
    quantiles, targets = 2 * normal(2, 3, 5), 2 * normal(3, 4, seed=1)
    found = quantile_huber(quantiles, targets)
    for k, b in np.ndindex(2, 3):
        total = 0.0
        for i, j in np.ndindex(5, 4):
            u = float(targets[b, j] - quantiles[k, b, i])
            huber = 0.5 * u**2 if abs(u) <= 1 else abs(u) - 0.5
            total += abs((2 * i + 1) / 10 - (u < 0)) * huber
        assert float(found[k, b]) == pytest.approx(total / 20, rel=1e-12)


def test_the_gradient_of_the_quantile_huber_loss_is_that_of_the_formula() -> None:
    """By qᵢ it is the mean over j of −|τᵢ − [u < 0]| · u, where u is cut off at ±1; O times less for the mean over i."""
    quantiles, targets = (2 * normal(2, 3, 5)).requires_grad_(), 2 * normal(3, 4, seed=1)
    (found,) = torch.autograd.grad(quantile_huber(quantiles, targets).sum(), quantiles)
    for k, b, i in np.ndindex(2, 3, 5):
        errors = (targets[b] - quantiles[k, b, i]).tolist()
        slopes = [-abs((2 * i + 1) / 10 - (u < 0)) * max(-1.0, min(1.0, u)) for u in errors]
        assert float(found[k, b, i]) == pytest.approx(sum(slopes) / 20, rel=1e-12)


def test_targets_are_the_lowest_of_all_critics_together_in_order() -> None:
    quantiles = normal(3, 4, 5)
    found = lowest(quantiles, 7)
    for b in range(4):
        assert found[b].tolist() == sorted(quantiles[:, b].flatten().tolist())[:7]


# -------------------------------------------------------------------- categories


def slowly_shifted(probabilities: Doubles, reward: float, discount: float, bound: float) -> Doubles:
    """Each atom's probability goes to the two atoms beside its return, which is cut at the bounds."""
    count = len(probabilities)
    step, found = 2 * bound / (count - 1), np.zeros(count)
    for i, probability in enumerate(probabilities):
        at = (max(-bound, min(bound, reward + discount * (-bound + i * step))) + bound) / step
        below, above = math.floor(at), math.ceil(at)
        if below == above:
            found[below] += probability
        else:
            found[below] += probability * (above - at)
            found[above] += probability * (at - below)
    return found


SHIFTS = ((0.3, 0.9), (-2.7, 0.5), (9.0, 0.99), (-30.0, 0.99), (1.25, 0.0), (5.0, 0.0), (-5.0, 0.0), (0.0, 1.0))


@pytest.mark.usefixtures("_float64")
def test_shifted_distributions_are_those_of_a_loop() -> None:
    """Within the bounds, beyond one of them, on a bound, and where no return follows."""
    categories, probabilities = Categories(11, 5.0), distributions(len(SHIFTS), 11)
    reward, discount = torch.tensor(SHIFTS, dtype=torch.float64).T
    found = categories.shifted(probabilities, reward, discount)
    for row, each, shift in zip(found, probabilities, SHIFTS, strict=True):
        np.testing.assert_allclose(row.numpy(), slowly_shifted(each.numpy(), *shift, 5.0), **ROUNDING)


@pytest.mark.usefixtures("_float64")
def test_shifting_keeps_the_mean_within_the_bounds() -> None:
    categories, probabilities = Categories(11, 5.0), distributions(3, 11)
    reward, discount = torch.tensor([0.3, -1.9, 2.45]), torch.tensor([0.9, 0.6, 0.5])
    found = categories.shifted(probabilities, reward, discount)
    torch.testing.assert_close(found @ categories.atoms, reward + discount * (probabilities @ categories.atoms), **ROUNDING)


def test_shifting_keeps_the_mass_also_in_float32() -> None:
    """Of many rows: positions are rounded, and may lie a little beyond the last atom."""
    generator = torch.Generator().manual_seed(0)
    probabilities = torch.randn(1000, 101, generator=generator).softmax(-1)
    reward, discount = 3 * torch.randn(1000, generator=generator), torch.rand(1000, generator=generator)
    found = Categories(101, 5.0).shifted(probabilities, reward, discount)
    assert (found >= 0).all()
    torch.testing.assert_close(found.sum(-1), torch.ones(1000), atol=101 * 2**-23, rtol=0)


@pytest.mark.parametrize(("reward", "atom"), [(7.0, -1), (math.inf, -1), (-7.0, 0), (-math.inf, 0)])
def test_a_return_beyond_a_bound_counts_as_the_bound(reward: float, atom: int) -> None:
    found = Categories(11, 5.0).shifted(torch.full((1, 11), 1 / 11), torch.tensor([reward]), torch.tensor([0.1]))
    assert float(found[0, atom]) == pytest.approx(1, abs=1e-6)


def test_the_mean_of_logits_is_that_of_their_distribution() -> None:
    logits = normal(2, 3, 11)
    weights = logits.exp()
    expected = (weights * torch.arange(-5, 6)).sum(-1) / weights.sum(-1)
    torch.testing.assert_close(Categories(11, 5.0).mean(logits), expected, **ROUNDING)


def test_the_cross_entropy_is_that_of_the_formula() -> None:
    logits, target = normal(2, 3, 5), distributions(3, 5, seed=1)
    probabilities = logits.exp() / logits.exp().sum(-1, keepdim=True)
    torch.testing.assert_close(Categories.cross_entropy(logits, target), -(target * probabilities.log()).sum(-1), **ROUNDING)


def test_the_gradient_of_the_cross_entropy_is_the_error_of_the_probabilities() -> None:
    logits, target = normal(2, 3, 5).requires_grad_(), distributions(3, 5, seed=1)
    (found,) = torch.autograd.grad(Categories.cross_entropy(logits, target).sum(), logits)
    torch.testing.assert_close(found, (logits.softmax(-1) - target).detach(), **ROUNDING)


# -------------------------------------------------------------------- a chain of two states

GAMMA = 0.5
FIRST, SECOND = torch.tensor([0.0, 1.0]), torch.tensor([-1.0, 2.0])
"""rewards of the first step and of the second, each with probability ½; then the episode ends"""
RETURNS = torch.tensor([0 - GAMMA, 0 + 2 * GAMMA, 1 - GAMMA, 1 + 2 * GAMMA])
"""from the first state on, each with probability ¼"""


def learned(outputs: int) -> tuple[Tensor, Optimizer]:
    """Outputs [2, O] of the two states, and what they are learned by."""
    found = trainable(torch.zeros(2, outputs), torch.zeros(2, outputs))
    return found, make_optimizer("adam", found)


def descend(loss: Tensor, outputs: Tensor, optimizer: Optimizer, learning_rate: float) -> None:
    assert outputs.grad is not None
    outputs.grad.zero_()
    loss.backward()  # type: ignore[no-untyped-call]
    optimizer.param_groups[0]["lr"] = learning_rate
    take_step(optimizer)


def test_categories_learn_the_mean_and_the_variance_of_the_returns_of_a_chain() -> None:
    """Each shift keeps the mean. It divides a return between two atoms, which adds to the variance at most step² / 4.

    Those of the first state are shifted once by their own reward, and once, times γ², by that of the second state.
    """
    categories = Categories(21, 5.3)  # so that no reward is that of an atom
    logits, optimizer = learned(21)
    nothing = torch.full((2, 21), 1 / 21)
    for _ in range(300):
        with torch.no_grad():
            after_first = categories.shifted(logits[1].softmax(-1).expand(2, -1), FIRST, torch.full((2,), GAMMA))
            after_second = categories.shifted(nothing, SECOND, torch.zeros(2))
        loss = categories.cross_entropy(logits[0].expand(2, -1), after_first).mean()
        loss = loss + categories.cross_entropy(logits[1].expand(2, -1), after_second).mean()
        descend(loss, logits, optimizer, 0.3)
    found = logits[0].detach().softmax(-1)
    mean = float(found @ categories.atoms)
    variance = float(found @ (categories.atoms - mean) ** 2)
    assert mean == pytest.approx(float(RETURNS.mean()), abs=0.01)
    true, added = float(RETURNS.var(correction=0)), categories.step**2 / 4 * (1 + GAMMA**2)
    assert true - 0.01 < variance < true + added + 0.01


def test_quantiles_learn_the_mean_and_the_variance_of_the_returns_of_a_chain() -> None:
    """Within 1 of a return, Huber's loss is quadratic, so that a quantile may lie 1 beside its place.

    Those of the first state then lie 1 + γ beside it, as quantiles of r + γ z move by no more than γ times what those of z
    do. So does their mean, and their standard deviation. Returns that are 1000 times as large make that small.
    """
    scale, count = 1000, 8  # each of the four returns has two quantiles
    quantiles, optimizer = learned(count)
    for left in range(400, 0, -1):
        targets = scale * FIRST[:, None] + GAMMA * quantiles[1].detach().sort().values
        loss = quantile_huber(quantiles[0].expand(1, 2, -1), targets).mean()
        loss = loss + quantile_huber(quantiles[1].expand(1, 2, -1), scale * SECOND[:, None]).mean()
        descend(loss, quantiles, optimizer, 50 * (left / 400) ** 2)
    found = quantiles[0].detach()
    assert float(found.mean()) == pytest.approx(scale * float(RETURNS.mean()), abs=1 + GAMMA)
    assert float(found.std(correction=0)) == pytest.approx(scale * float(RETURNS.std(correction=0)), abs=1 + GAMMA)
