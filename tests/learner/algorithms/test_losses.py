"""Losses against the papers' numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from learner.algorithms import losses


def test_surrogate_is_the_papers() -> None:
    ratio, advantage = torch.tensor([0.5, 0.5, 1.5, 1.5, 1.1]), torch.tensor([1.0, -1.0, 1.0, -1.0, 2.0])
    loss = losses.clipped_surrogate(ratio.log(), advantage, 0.2)
    torch.testing.assert_close(loss, -torch.tensor([0.5, -0.8, 1.2, -1.5, 2.2]).mean())
    assert losses.clip_fraction(ratio.log(), 0.2).item() == pytest.approx(0.8)


def test_a_clipped_value_earns_nothing_by_moving_further() -> None:
    """Before 0, clipped to ±1, target 5: at 0.5 it is drawn on, at 2 it has gone far enough, at −2 it is drawn back."""
    value, target = torch.tensor([0.5, 2.0, -2.0]), torch.tensor([5.0, 5.0, 5.0])
    loss = losses.clipped_value_loss(value.requires_grad_(), target, torch.zeros(3), 1.0)
    (gradient,) = torch.autograd.grad(loss, value)
    torch.testing.assert_close(loss.detach(), torch.tensor([4.5**2, 4.0**2, 7.0**2]).mean())
    torch.testing.assert_close(gradient, torch.tensor([-9.0, 0.0, -14.0]) / 3)


def test_explained_variance() -> None:
    target = np.array([1.0, 2.0, 3.0], np.float32)
    assert losses.explained_variance(target, target) == 1
    assert losses.explained_variance(np.zeros(3, np.float32), target) == 0
    assert losses.explained_variance(-target, target) == pytest.approx(-3)
    assert np.isnan(losses.explained_variance(target, np.ones(3, np.float32)))


def test_approx_kl_is_zero_where_nothing_moved_and_never_negative() -> None:
    log_ratio = torch.linspace(-1, 1, 9)
    assert losses.approx_kl(torch.zeros(3)) == 0
    assert all(losses.approx_kl(x[None]) >= 0 for x in log_ratio)
    torch.testing.assert_close(losses.approx_kl(log_ratio), (log_ratio.exp() - 1 - log_ratio).mean())


def test_standardized_advantages_have_mean_0_and_std_1() -> None:
    found = losses.standardized(torch.tensor([1.0, 5.0, 9.0]))
    torch.testing.assert_close(found, torch.tensor([-1.0, 0.0, 1.0]))
    assert losses.standardized(torch.tensor([3.0])).tolist() == [3.0]
