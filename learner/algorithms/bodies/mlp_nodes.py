"""MLPs as one node of autograd's graph, in torch. With one node per operation, small networks are slow.

Forward: h₀ = x [B, D];  hᵢ = φ(hᵢ₋₁ Wᵢᵀ + bᵢ);  output = h Wᵀ + b [B, O].
Backward: with g = ∂L/∂(pre-activation), ∂L/∂W = gᵀ h, ∂L/∂b = Σ g, ∂L/∂h = g W; φ' is 1 − h² (tanh) or h > 0 (ReLU).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def refuse_second_derivatives() -> None:
    """Raise `RuntimeError` in a backward pass with `create_graph`, whose result would lack the terms of hidden layers."""
    if torch.is_grad_enabled():
        raise RuntimeError("millrace's networks have no second derivatives; call backward without create_graph")


class MLPNode(torch.autograd.Function):
    """Hidden layers and a linear head. [B, D] -> [B, O]."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, relu: bool, *layers: Tensor) -> Tensor:
        """`layers` alternates weight [out, in] and bias [out]; the last pair is the head."""
        inputs = [x]
        *hidden, weight, bias = layers
        for w, b in zip(hidden[::2], hidden[1::2], strict=True):
            x = torch.addmm(b, x, w.t())
            inputs.append(x.relu_() if relu else x.tanh_())
        ctx.relu = relu
        ctx.save_for_backward(*inputs, *layers[::2])
        return torch.addmm(bias, x, weight.t())

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients with respect to x (if needed), and to each layer's weight and bias."""
        refuse_second_derivatives()
        (g,) = outputs
        half = len(ctx.saved_tensors) // 2
        inputs = ctx.saved_tensors[:half]
        weights = ctx.saved_tensors[half:]
        gradients: list[Tensor | None] = []
        for i in range(half - 1, 0, -1):
            gradients += [g.sum(0), g.t() @ inputs[i]]
            g = g @ weights[i]
            if ctx.relu:
                g = torch.ops.aten.threshold_backward(g, inputs[i], 0)
            else:
                g = torch.ops.aten.tanh_backward(g, inputs[i])
        gradients += [g.sum(0), g.t() @ inputs[0], None, g @ weights[0] if ctx.needs_input_grad[0] else None]
        return tuple(reversed(gradients))


class StackedMLPNode(torch.autograd.Function):
    """K networks of the same shape on the same input: `MLPNode` with batched products. [B, D] -> [K, B, O]."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, relu: bool, flat: Tensor, layers_of: Callable[[Tensor], list[Tensor]]) -> Tensor:
        """`layers_of` returns the layers as views of a tensor like `flat`: weight [K, out, in] and bias [K, out] in turn."""
        *hidden, weight, bias = layers = layers_of(flat)
        x = x.expand(len(weight), *x.shape)
        inputs = [x]
        for w, b in zip(hidden[::2], hidden[1::2], strict=True):
            x = torch.baddbmm(b.unsqueeze(1), x, w.mT)
            inputs.append(x.relu_() if relu else x.tanh_())
        ctx.relu = relu
        ctx.layers_of = layers_of
        ctx.size = len(flat)
        ctx.save_for_backward(*inputs, *layers[::2])
        return torch.baddbmm(bias.unsqueeze(1), x, weight.mT)

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients with respect to x and to `flat`, each only if it is needed."""
        refuse_second_derivatives()
        (g,) = outputs
        half = len(ctx.saved_tensors) // 2
        inputs = ctx.saved_tensors[:half]
        weights = ctx.saved_tensors[half:]
        _, _, trains, _ = ctx.needs_input_grad
        by_flat = g.new_zeros(ctx.size) if trains else None
        by_layers = [] if by_flat is None else ctx.layers_of(by_flat)
        for i in range(half - 1, -1, -1):
            if trains:
                by_layers[2 * i].copy_(g.mT @ inputs[i])
                by_layers[2 * i + 1].copy_(g.sum(1))
            if i:
                g = g @ weights[i]
                if ctx.relu:
                    g = torch.ops.aten.threshold_backward(g, inputs[i], 0)
                else:
                    g = torch.ops.aten.tanh_backward(g, inputs[i])
        return (g @ weights[0]).sum(0) if ctx.needs_input_grad[0] else None, None, by_flat, None
