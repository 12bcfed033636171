"""Leaves of autograd's graph that share the memory of flat tensors, so one operation changes a network's parameters."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from millrace.protocol.policy.layout import Field, named_views


def trainable(values: Tensor, gradient: Tensor | None) -> Tensor:
    """A leaf of autograd's graph that shares the memory of `values`. Its gradient is `gradient`."""
    leaf = values.detach().requires_grad_()
    leaf.grad = gradient
    return leaf


def named_leaves(values: Tensor, gradient: Tensor, fields: Sequence[Field]) -> dict[str, Tensor]:
    """A leaf of autograd's graph for each field, by name: a view of `values`. Its gradient is a view of `gradient`."""
    gradients = named_views(gradient, fields)
    return {name: trainable(view, gradients[name]) for name, view in named_views(values, fields).items()}
