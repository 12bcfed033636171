"""Losses against the papers' numbers, and the gradients derived by hand against autograd's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from learner.algorithms import losses
from learner.algorithms.kernels import loss_gradients

Case = Callable[[Any, Any, Callable[[Tensor], Any]], Any]

GENERATOR = torch.Generator().manual_seed(0)
X = 0.5 * torch.randn(50, generator=GENERATOR, dtype=torch.float64)
ADVANTAGE, TARGET = torch.randn(2, 50, generator=GENERATOR, dtype=torch.float64)
WEIGHT = torch.rand(50, generator=GENERATOR, dtype=torch.float64)

CASES: dict[str, Case] = {  # (module that has the loss, x, conversion of the other arguments) -> what its function returns
    "clipped surrogate": lambda of, x, to: of.clipped_surrogate(losses.ratio(x, 0 * x)[1], to(ADVANTAGE), 0.2),
    "policy gradient": lambda of, x, to: of.policy_gradient(x, to(ADVANTAGE)),
    "clipped value": lambda of, x, to: of.clipped_value_loss(x, to(TARGET), to(ADVANTAGE), 0.4),
    "value": lambda of, x, to: of.value_loss(x, to(TARGET)),
    "entropy": lambda of, x, to: of.entropy_loss(x),
    "huber": lambda of, x, to: of.huber_loss(x, to(WEIGHT)),
    "squared": lambda of, x, to: of.squared_loss(x, to(WEIGHT)),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("numpy", [False, True])
def test_losses_with_gradients_derived_by_hand_are_those_of_autograd(name: str, numpy: bool) -> None:
    """In float64, with torch tensors and with numpy arrays."""
    x = (3 * X if name == "huber" else X).clone().requires_grad_()  # some errors beyond 1
    loss = CASES[name](losses, x, lambda other: other)
    (expected,) = torch.autograd.grad(loss, x)
    if numpy:
        found = CASES[name](loss_gradients, x.detach().numpy(), Tensor.numpy)
    else:
        found = CASES[name](loss_gradients, x.detach(), lambda other: other)
    torch.testing.assert_close(torch.as_tensor(found[0]), loss.detach())
    torch.testing.assert_close(torch.as_tensor(found[1]), expected)


def test_the_cases_of_the_losses_reach_every_branch() -> None:
    assert (loss_gradients.clipped_surrogate(X.exp(), ADVANTAGE, 0.2)[1] == 0).any()  # some rows are clipped
    assert (loss_gradients.clipped_value_loss(X, TARGET, ADVANTAGE, 0.4)[1] == 0).any()
    assert ((3 * X).abs() > 1).any()


def test_surrogate_is_the_papers() -> None:
    ratio, advantage = torch.tensor([0.5, 0.5, 1.5, 1.5, 1.1]), torch.tensor([1.0, -1.0, 1.0, -1.0, 2.0])
    loss = losses.clipped_surrogate(ratio, advantage, 0.2)
    torch.testing.assert_close(loss, -torch.tensor([0.5, -0.8, 1.2, -1.5, 2.2]).mean())
    assert losses.clip_fraction(ratio, 0.2).item() == pytest.approx(0.8)


def test_a_clipped_value_earns_nothing_by_moving_further() -> None:
    """Before 0, clipped to ±1, target 5: at 0.5 it is drawn on, at 2 it has gone far enough, at −2 it is drawn back."""
    value, target = torch.tensor([0.5, 2.0, -2.0]), torch.tensor([5.0, 5.0, 5.0])
    loss, gradient = loss_gradients.clipped_value_loss(value, target, torch.zeros(3), 1.0)
    torch.testing.assert_close(loss, torch.tensor([4.5**2, 4.0**2, 7.0**2]).mean())
    torch.testing.assert_close(gradient, torch.tensor([-9.0, 0.0, -14.0]) / 3)


def test_explained_variance() -> None:
    target = np.array([1.0, 2.0, 3.0], np.float32)
    assert losses.explained_variance(target, target) == 1
    assert losses.explained_variance(np.zeros(3, np.float32), target) == 0
    assert losses.explained_variance(-target, target) == pytest.approx(-3)
    assert np.isnan(losses.explained_variance(target, np.ones(3, np.float32)))


def test_approx_kl_is_zero_where_nothing_moved_and_never_negative() -> None:
    log_ratio = torch.linspace(-1, 1, 9)
    assert losses.approx_kl(torch.zeros(3), torch.ones(3)) == 0
    assert all(losses.approx_kl(x[None], x[None].exp()) >= 0 for x in log_ratio)
    torch.testing.assert_close(losses.approx_kl(log_ratio, log_ratio.exp()), (log_ratio.exp() - 1 - log_ratio).mean())


def test_standardized_advantages_have_mean_0_and_std_1() -> None:
    found = losses.standardized(torch.tensor([1.0, 5.0, 9.0]))
    torch.testing.assert_close(found, torch.tensor([-1.0, 0.0, 1.0]))
    assert losses.standardized(torch.tensor([3.0])).tolist() == [3.0]
