"""A pass of a whole minibatch through MLPs with batch normalization, as one node of autograd's graph.

Rule: a layer's mean and variance are those of the whole minibatch, so all rows pass through one layer before any row enters
the next. That is why this pass isn't divided into chunks of rows, unlike the pass in `kernels/mlp.py`.

Arrays are [K, n, B] (K networks, n features, B rows), so a sum over the minibatch reads contiguous memory, and one call
normalizes the features of all networks. With x̂ = (h − μ) / σ, where σ² = variance + ε, and g = ∂L/∂(γ x̂ + β): ∂L/∂β = Σ g,
∂L/∂γ = Σ g x̂, ∂L/∂h = γ / σ · (g − mean(g) − x̂ mean(g x̂)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.mlp_nodes import refuse_second_derivatives

EPS = 1e-3
"""the ε added to each variance, as in CrossQ and XQC"""
MOMENTUM = 0.01
"""the fraction by which running means and variances move towards a minibatch's means and variances"""


class Layer(NamedTuple):
    """A linear layer of K networks, and the normalization in front of it: views of a flat tensor, or of its gradient."""

    gain: Tensor
    """[K, in, 1] γ"""
    shift: Tensor
    """[K, in, 1] β"""
    weight: Tensor
    """[K, out, in]"""
    bias: Tensor | None
    """[K, out, 1]"""


class RunningStatistics(NamedTuple):
    """The running statistics of one normalization: views of a flat tensor."""

    mean: Tensor
    """[K, n, 1]"""
    variance: Tensor
    """[K, n, 1] variance of the population"""


class Plan(NamedTuple):
    """The structure of the MLPs in a pass."""

    layers_of: Callable[[Tensor], Sequence[Layer]]
    """returns the layers as views of a tensor that is laid out like the flat parameters"""
    relu: bool
    """whether activations are ReLU; if not, they are tanh"""
    before: bool
    """whether to normalize before each activation; if not, after it"""


class NormalizedPass(torch.autograd.Function):
    """Maps rows x [B, D] to outputs [K, B, O]."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, flat: Tensor, plan: Plan, running: Sequence[RunningStatistics] | None, renormalizes: bool
    ) -> Tensor:
        """The outputs [K, B, O]. Moves `running`, unless it is None, towards the minibatch's statistics.

        For `renormalizes`, see `_normalized`.
        """
        h = x.t().contiguous().unsqueeze(0)
        kept = []
        for i, layer in enumerate(plan.layers_of(flat)):
            statistics = None if running is None else running[i]
            if i and not plan.before:
                h = _activation(h, plan.relu)
            activated = h
            h, normalization = _normalized(h, layer, statistics, renormalizes, in_place=i > 0 and plan.before)
            if i and plan.before:
                h = activated = _activation(h, plan.relu)
            kept.append((normalization, activated, h))
            h = torch.bmm(layer.weight, h) if layer.bias is None else torch.baddbmm(layer.bias, layer.weight, h)
        ctx.kept = kept
        ctx.plan = plan
        ctx.save_for_backward(flat)  # makes torch raise if an optimizer step changes it before the backward pass
        return h.mT

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        """The gradients with respect to x and to the flat parameters."""
        refuse_second_derivatives()
        (flat,) = ctx.saved_tensors
        plan = ctx.plan
        by_flat = torch.zeros_like(flat)
        layers = plan.layers_of(flat)
        by_layers = plan.layers_of(by_flat)
        g = outputs[0].mT
        for i in reversed(range(len(layers))):
            layer = layers[i]
            by_layer = by_layers[i]
            normalization, activated, h = ctx.kept[i]
            by_layer.weight.copy_(torch.bmm(g, h.mT))
            if by_layer.bias is not None:
                by_layer.bias.copy_(g.sum(-1, keepdim=True))
            g = torch.bmm(layer.weight.mT, g)
            if i and plan.before:
                g = _before_activation(g, activated, plan.relu)
            g = normalization.backward(g, layer, by_layer)
            if i and not plan.before:
                g = _before_activation(g, activated, plan.relu)
        by_x = g.sum(0).t() if ctx.needs_input_grad[0] else None
        return by_x, by_flat, None, None, None


class _Normalization(NamedTuple):
    """The intermediate results of a normalization that its backward pass needs."""

    x_hat: Tensor
    """[K or 1, n, B]"""
    inverse: Tensor
    """[K or 1, n, 1] 1/σ"""
    r: Tensor | None
    """[K, n, 1] r and d of batch renormalization; both None without it"""
    d: Tensor | None

    def backward(self, g: Tensor, layer: Layer, by_layer: Layer) -> Tensor:
        """The gradient [K, n, B] with respect to the input, from `g`, the gradient of the result. Overwrites `g`."""
        total = g.sum(-1, keepdim=True)
        product = _row_products(g, self.x_hat.expand_as(g))
        by_layer.shift.copy_(total)
        by_layer.gain.copy_(product if self.r is None or self.d is None else self.r * product + self.d * total)
        gain = layer.gain if self.r is None else layer.gain * self.r
        rows = g.shape[-1]
        return g.sub_(total / rows).addcmul_(self.x_hat, product / -rows).mul_(gain * self.inverse)


def _normalized(
    h: Tensor, layer: Layer, running: RunningStatistics | None, renormalizes: bool, in_place: bool
) -> tuple[Tensor, _Normalization]:
    """γ x̂ + β [K, n, B] for h [K or 1, n, B], and the intermediate results that the backward pass needs.

    With batch renormalization (Ioffe 2017), the result is γ (r x̂ + d) + β. As long as r and d are within their bounds, this
    equals a normalization by the running statistics. The backward pass treats r and d as constants.
    """
    mean = h.mean(-1, keepdim=True)
    x_hat = h.sub_(mean) if in_place else h - mean
    variance = _row_products(x_hat, x_hat) / h.shape[-1]
    inverse = (variance + EPS).rsqrt()
    x_hat.mul_(inverse)
    gain = layer.gain
    shift = layer.shift
    r = None
    d = None
    if running is not None:
        if renormalizes:
            r, d = renormalization(mean, inverse, running)
            shift = shift + gain * d
            gain = gain * r
        running.mean.lerp_(mean.expand_as(running.mean), MOMENTUM)
        running.variance.lerp_(variance.expand_as(running.variance), MOMENTUM)
    return torch.addcmul(shift, x_hat, gain), _Normalization(x_hat, inverse, r, d)


R_MAX = 3.0
D_MAX = 5.0
"""The bounds of batch renormalization: R_MAX for σ / σ(running) and its inverse, D_MAX for |μ − μ(running)| / σ(running)"""


def renormalization(mean: Tensor, inverse: Tensor, running: RunningStatistics) -> tuple[Tensor, Tensor]:
    """The pair r = σ / σ(running) and d = (μ − μ(running)) / σ(running), clipped to their bounds, [K, n, 1] each."""
    running_inverse = (running.variance + EPS).rsqrt()
    r = (running_inverse / inverse).clamp(1 / R_MAX, R_MAX)
    return r, ((mean - running.mean) * running_inverse).clamp(-D_MAX, D_MAX)


def _row_products(a: Tensor, b: Tensor) -> Tensor:
    """Σ a b over the last dimension, which is kept with size 1.

    On a CPU, this uses numpy, which adds while it multiplies; torch would store all products first.
    """
    if a.device.type != "cpu":
        return (a * b).sum(-1, keepdim=True)
    return torch.from_numpy(np.vecdot(a.numpy(), b.numpy())).unsqueeze(-1)


def _activation(h: Tensor, relu: bool) -> Tensor:
    """φ(h), in the memory of h."""
    return h.relu_() if relu else h.tanh_()


def _before_activation(g: Tensor, activated: Tensor, relu: bool) -> Tensor:
    """The gradient with respect to h, from `g`, the gradient with respect to φ(h)."""
    by_pre_activation: Tensor = (
        torch.ops.aten.threshold_backward(g, activated, 0) if relu else torch.ops.aten.tanh_backward(g, activated)
    )
    return by_pre_activation
