"""StackedMLPs against a plain formula in float64: each way to pass, gradients, running statistics, and folding."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.autograd_leaves import trainable
from millrace.learner.algorithms.bodies.stacked_mlps import (
    MLPShape,
    Normalized,
    StackedMLPs,
    initial,
    initial_statistics,
)
from millrace.protocol.policy.layout import total_size
from tests.learner.algorithms.bodies import plain_formula as plain
from tests.support.variants import variants

SIZES = (3, 6, 5, 2)
ROUNDING: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-11}
"""numbers of the size of 1 in float64, after some hundred operations; a division by a small σ multiplies by at most 32"""
NORMALIZED = pytest.mark.parametrize("normalized", [Normalized.BEFORE, Normalized.AFTER])
ALL = pytest.mark.parametrize("normalized", list(Normalized))
RELU = pytest.mark.parametrize("relu", [True, False], ids=["relu", "tanh"])


class Made:
    """Two networks with numbers that are neither 0 nor 1, and rows to pass."""

    def __init__(self, normalized: Normalized, *, relu: bool = True, unit_rows: bool = False) -> None:
        generator = torch.Generator().manual_seed(0)
        self.shape = MLPShape(2, SIZES, relu, normalized, unit_rows)
        noise = torch.randn(total_size(self.shape.fields()), generator=generator, dtype=torch.float64)
        self.flat = initial(self.shape, generator).double() + 0.3 * noise
        self.gradient = torch.zeros_like(self.flat)
        self.statistics = initial_statistics(self.shape).double()
        for mean, variance in (pair for network in plain.statistics(self.shape, self.statistics) for pair in network):
            mean.copy_(torch.randn(len(mean), generator=generator))
            variance.copy_(0.5 + torch.rand(len(mean), generator=generator))
        self.bodies = StackedMLPs(self.shape, trainable(self.flat, self.gradient), self.statistics)
        self.x = 1 + 2 * torch.randn(8, SIZES[0], generator=generator, dtype=torch.float64)
        self.direction = torch.randn(2, 8, SIZES[-1], generator=generator, dtype=torch.float64)

    def formula(self, normalize: Any = plain.of_minibatch, x: Tensor | None = None, flat: Tensor | None = None) -> Tensor:
        """Outputs of the formula for the parameters and statistics that there are now."""
        some = self.flat if flat is None else flat, self.x if x is None else x
        return plain.outputs(self.shape, *some, normalize, self.statistics.clone())

    def gradients(self, normalize: Any = plain.of_minibatch) -> tuple[Tensor, Tensor]:
        """Those of x and of the parameters, along `direction`."""
        x, flat = self.x.clone().requires_grad_(), self.flat.clone().requires_grad_()
        by_x, by_flat = torch.autograd.grad((self.direction * self.formula(normalize, x, flat)).sum(), (x, flat))
        return by_x, by_flat


def backward(made: Made, **how: Any) -> tuple[Tensor, Tensor]:
    """The gradients of x and of the parameters that `trained` gives, along `direction`."""
    x = made.x.clone().requires_grad_()
    (made.direction * made.bodies.trained(x, **how)).sum().backward()  # type: ignore[no-untyped-call]
    assert x.grad is not None
    return x.grad, made.gradient


# -------------------------------------------------------------------- passes that train


@ALL
@RELU
def test_outputs_are_those_of_the_formula(normalized: Normalized, relu: bool) -> None:
    made = Made(normalized, relu=relu)
    torch.testing.assert_close(made.bodies.trained(made.x).detach(), made.formula(), **ROUNDING)


@ALL
@RELU
def test_gradients_of_rows_and_parameters_are_those_of_autograd(normalized: Normalized, relu: bool) -> None:
    made = Made(normalized, relu=relu)
    expected = made.gradients()
    for found, each in zip(backward(made), expected, strict=True):
        torch.testing.assert_close(found, each, **ROUNDING)


@NORMALIZED
def test_running_statistics_are_those_of_a_recursion_in_numpy(normalized: Normalized) -> None:
    made = Made(normalized)
    expected = [part.numpy().copy() for k in plain.statistics(made.shape, made.statistics) for pair in k for part in pair]
    for _ in range(3):
        given = [h.numpy() for _, network in plain.passes(made.shape, made.flat, made.x) for h in network]
        found = [part for h in given for part in (h.mean(0), h.var(0))]
        expected = [0.99 * running + 0.01 * part for running, part in zip(expected, found, strict=True)]
        made.bodies.trained(made.x)
        made.x = 2 * made.x + 1
    now = [part for k in plain.statistics(made.shape, made.statistics) for pair in k for part in pair]
    for mine, theirs in zip(now, expected, strict=True):
        np.testing.assert_allclose(mine.numpy(), theirs, rtol=1e-12, atol=1e-13)


@NORMALIZED
def test_one_network_knows_nothing_of_another(normalized: Normalized) -> None:
    made = Made(normalized)
    made.direction[1] = 0
    backward(made)
    first, second = plain.layers(made.shape, made.gradient)
    assert all(float(part.abs().sum()) > 0 for part in first[-1])
    assert not any(part.any() for layer in second for part in layer)


@ALL
def test_a_graph_is_passed_backwards_once(normalized: Normalized) -> None:
    made = Made(normalized)
    loss = made.bodies.trained(made.x).sum()
    loss.backward()  # type: ignore[no-untyped-call]
    with pytest.raises(RuntimeError, match="second time"):
        loss.backward()  # type: ignore[no-untyped-call]


@ALL
def test_a_gradient_after_a_step_is_refused(normalized: Normalized) -> None:
    """It would be that of other parameters."""
    made = Made(normalized)
    loss = made.bodies.trained(made.x).sum()
    with torch.no_grad():  # as optimizers do it
        made.flat.add_(0.1)
    with pytest.raises(RuntimeError, match=r"modified (by an )?inplace"):
        loss.backward()  # type: ignore[no-untyped-call]


@ALL
def test_second_derivatives_are_refused(normalized: Normalized) -> None:
    made = Made(normalized)
    x = made.x.clone().requires_grad_()
    with pytest.raises(RuntimeError, match="second derivative"):
        torch.autograd.grad(made.bodies.trained(x).sum(), x, create_graph=True)


# -------------------------------------------------------------------- batch renormalization


@NORMALIZED
def test_renormalized_outputs_are_those_of_the_formula(normalized: Normalized) -> None:
    made = Made(normalized)
    expected = made.formula(plain.renormalized)
    assert (expected - made.formula()).abs().max() > 0.1, "it makes a difference"
    torch.testing.assert_close(made.bodies.trained(made.x, renormalizes=True).detach(), expected, **ROUNDING)


@NORMALIZED
@RELU
def test_renormalized_gradients_are_those_of_autograd_with_r_and_d_constant(normalized: Normalized, relu: bool) -> None:
    made = Made(normalized, relu=relu)
    expected = made.gradients(plain.renormalized)
    for found, each in zip(backward(made, renormalizes=True), expected, strict=True):
        torch.testing.assert_close(found, each, **ROUNDING)


@pytest.mark.parametrize(
    ("mean", "variance", "factor", "offset"),
    [
        (0.0, 2.0**2 - 1e-3, 0.5, 0.5),  # within the bounds: as with the running statistics
        (0.0, 0.1**2 - 1e-3, 3.0, 5.0),
        (0.0, 50.0**2, 1 / 3, 1 / 50),
        (1e4, 1.0**2 - 1e-3, 1.0, -5.0),
    ],
)
def test_r_and_d_have_bounds(mean: float, variance: float, factor: float, offset: float) -> None:
    """One feature of mean 1 and deviation 1 passes a normalization alone: r is `factor`, d is `offset`."""
    shape = MLPShape(1, (1, 1), True, Normalized.AFTER)
    flat = torch.tensor([1.0, 0.0, 1.0, 0.0], dtype=torch.float64)  # gain, shift, weight, bias
    bodies = StackedMLPs(shape, trainable(flat, torch.zeros_like(flat)), torch.tensor([mean, variance], dtype=torch.float64))
    std = math.sqrt(1 - 1e-3)  # so that σ, with its ε, is 1
    x = torch.tensor([[1 - std], [1 + std]], dtype=torch.float64)
    found = bodies.trained(x, renormalizes=True).detach()[0, :, 0]
    expected = torch.tensor([-std * factor + offset, std * factor + offset], dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-9)


@NORMALIZED
def test_renormalization_moves_running_statistics_as_batch_normalization_does_in_the_first_layer(
    normalized: Normalized,
) -> None:
    """Those of later layers are of what the first passes on, which is something else."""
    moved = []
    for renormalizes in (False, True):
        made = Made(normalized)
        made.bodies.trained(made.x, renormalizes=renormalizes)
        moved.append(plain.statistics(made.shape, made.statistics)[1])
    torch.testing.assert_close(moved[0][0], moved[1][0], rtol=0, atol=0)
    assert not torch.equal(moved[0][1].mean, moved[1][1].mean)


# -------------------------------------------------------------------- passes that train nothing


@ALL
def test_a_pass_of_targets_gives_what_one_that_trains_gives(normalized: Normalized) -> None:
    made = Made(normalized)
    assert torch.equal(made.bodies.of_minibatch(made.x), made.bodies.trained(made.x).detach())


@ALL
def test_a_pass_of_targets_moves_no_statistics_and_has_no_gradient(normalized: Normalized) -> None:
    made = Made(normalized)
    before = made.statistics.clone()
    assert not made.bodies.of_minibatch(made.x).requires_grad
    assert torch.equal(made.statistics, before)


@ALL
@RELU
def test_evaluation_normalizes_by_running_statistics(normalized: Normalized, relu: bool) -> None:
    made = Made(normalized, relu=relu)
    before = made.statistics.clone()
    torch.testing.assert_close(made.bodies.evaluated(made.x), made.formula(plain.evaluated), **ROUNDING)
    assert torch.equal(made.statistics, before)


@ALL
@RELU
def test_folded_parameters_are_those_of_a_plain_mlp_that_acts_alike(normalized: Normalized, relu: bool) -> None:
    made = Made(normalized, relu=relu)
    plain_shape = MLPShape(2, SIZES, relu)
    found = plain.outputs(plain_shape, made.bodies.folded(), made.x)
    torch.testing.assert_close(found, made.formula(plain.evaluated), **ROUNDING)


@ALL
@RELU
def test_of_an_evaluation_rows_alone_get_a_gradient(normalized: Normalized, relu: bool) -> None:
    made = Made(normalized, relu=relu)
    x = made.x.clone().requires_grad_()
    (made.direction * made.bodies.evaluated(x)).sum().backward()  # type: ignore[no-untyped-call]
    torch.testing.assert_close(x.grad, made.gradients(plain.evaluated)[0], **ROUNDING)
    assert not made.gradient.any()


# -------------------------------------------------------------------- the parameters


@ALL
def test_projected_weights_of_each_unit_have_norm_1_and_their_direction(normalized: Normalized) -> None:
    made = Made(normalized, unit_rows=True)
    before = plain.every_layer(made.shape, made.flat.clone())
    made.bodies.project()
    for old, new in zip(before, plain.every_layer(made.shape, made.flat), strict=True):
        torch.testing.assert_close(new.weight, old.weight / old.weight.square().sum(1, keepdim=True).sqrt(), **ROUNDING)


@ALL
def test_a_projection_changes_weights_alone(normalized: Normalized) -> None:
    made = Made(normalized, unit_rows=True)
    before = plain.every_layer(made.shape, made.flat.clone())
    made.bodies.project()
    for old, new in zip(before, plain.every_layer(made.shape, made.flat), strict=True):
        assert not torch.equal(old.weight, new.weight)
        assert all(torch.equal(getattr(old, name), getattr(new, name)) for name in ("gain", "shift", "bias"))


def test_weights_of_any_norm_stay_as_they_are_without_unit_rows() -> None:
    made = Made(Normalized.BEFORE)
    before = made.flat.clone()
    made.bodies.project()
    assert torch.equal(made.flat, before)


@pytest.mark.parametrize("normalized", variants(Normalized, default=[Normalized.AFTER]))
def test_parameters_begin_with_orthogonal_weights_that_differ_between_networks(normalized: Normalized) -> None:
    shape = MLPShape(2, (8, 6, 4), normalized=normalized, output_gain=0.01)
    first, second = plain.layers(shape, initial(shape, torch.Generator().manual_seed(0)))
    assert not torch.equal(first[0].weight, second[0].weight)
    for hidden, out in (first, second):
        torch.testing.assert_close(hidden.weight @ hidden.weight.T, 2 * torch.eye(6), atol=1e-5, rtol=0)
        torch.testing.assert_close(out.weight @ out.weight.T, 1e-4 * torch.eye(4), atol=1e-9, rtol=0)
        assert all((layer.gain == 1).all() and not layer.shift.any() and not layer.bias.any() for layer in (hidden, out))


def test_running_statistics_begin_with_means_of_0_and_variances_of_1() -> None:
    shape = MLPShape(2, SIZES, normalized=Normalized.BEFORE)
    for network in plain.statistics(shape, initial_statistics(shape)):
        for mean, variance in network:
            assert not mean.any()
            assert (variance == 1).all()
