"""Losses against the papers' numbers, and the gradients derived by hand against autograd's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from learner.algorithms import losses


def test_gradients_derived_by_hand_are_those_of_autograd() -> None:
    generator = torch.Generator().manual_seed(0)
    log_ratio = (0.5 * torch.randn(50, generator=generator, dtype=torch.float64)).requires_grad_()
    advantage, target = torch.randn(2, 50, generator=generator, dtype=torch.float64)
    ratio = log_ratio.exp()
    cases = {
        "policy": (losses.clipped_surrogate(ratio, advantage, 0.2), log_ratio),
        "plain policy": (losses.policy_gradient(log_ratio, advantage), log_ratio),
        "clipped value": (losses.clipped_value_loss(log_ratio, target, advantage, 0.4), log_ratio),
        "value": (losses.value_loss(log_ratio, target), log_ratio),
        "entropy": (losses.entropy_loss(log_ratio), log_ratio),
    }
    for name, ((loss, gradient), by) in cases.items():
        (expected,) = torch.autograd.grad(loss, by, retain_graph=True)
        torch.testing.assert_close(gradient.detach(), expected, msg=name)
    assert (losses.clipped_surrogate(ratio, advantage, 0.2)[1] == 0).any()  # some rows are clipped


def test_surrogate_is_the_papers() -> None:
    ratio, advantage = torch.tensor([0.5, 0.5, 1.5, 1.5, 1.1]), torch.tensor([1.0, -1.0, 1.0, -1.0, 2.0])
    loss, _ = losses.clipped_surrogate(ratio, advantage, 0.2)
    torch.testing.assert_close(loss, -torch.tensor([0.5, -0.8, 1.2, -1.5, 2.2]).mean())
    assert losses.clip_fraction(ratio, 0.2).item() == pytest.approx(0.8)


def test_a_clipped_value_earns_nothing_by_moving_further() -> None:
    """Before 0, clipped to ±1, target 5: at 0.5 it is drawn on, at 2 it has gone far enough, at −2 it is drawn back."""
    value, target = torch.tensor([0.5, 2.0, -2.0]), torch.tensor([5.0, 5.0, 5.0])
    loss, gradient = losses.clipped_value_loss(value, target, torch.zeros(3), 1.0)
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
