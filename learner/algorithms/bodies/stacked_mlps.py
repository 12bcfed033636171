"""MLPs with the same shape, with or without batch normalization (Ioffe and Szegedy 2015), and how they fold into plain MLPs.

Rule: a training pass normalizes by the mean and variance of its own minibatch, and moves the running statistics towards
these. A pass that doesn't train these MLPs, such as one that computes actions, uses the running statistics. (Targets are an
exception, see `of_minibatch`.) Batch normalization is then linear, so it is folded into the linear layers. Workers therefore
act with a plain MLP, and need neither statistics nor PyTorch.

With `Normalized.BEFORE`, an MLP begins with batch normalization (BN), continues with a linear layer, BN and an activation
for each hidden layer, and ends with a linear layer (XQC, Palenicek et al. 2025). With `Normalized.AFTER`, there is a BN in
front of every linear layer (CrossQ, Bhatt et al. 2024).
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.mlp_nodes import StackedMLPNode
from millrace.learner.algorithms.bodies.networks import DTYPE
from millrace.learner.algorithms.bodies.normalized_pass import EPS, Layer, NormalizedPass, Plan, RunningStatistics
from millrace.protocol.policy.layout import Field, named_views, total_size


class Normalized(Enum):
    """Where an MLP normalizes."""

    NOWHERE = "none"
    BEFORE = "before activations"
    """the input, and again before each activation; hidden layers have no biases, because subtracting means cancels them"""
    AFTER = "after activations"
    """the input, and again after each activation"""


class MLPShape(NamedTuple):
    """The shape that K MLPs have in common."""

    networks: int
    """K, the number of MLPs"""
    sizes: tuple[int, ...]
    """the number of inputs, the number of units of each hidden layer, and the number of outputs"""
    relu: bool = True
    """whether activations are ReLU; if not, they are tanh"""
    normalized: Normalized = Normalized.NOWHERE
    unit_rows: bool = False
    """whether the weights of each unit are kept at norm 1 (weight normalization)"""
    output_gain: float = 1.0
    """the gain of the orthogonal initialization of the last layer; it is √2 for the other layers"""

    def fields(self) -> list[Field]:
        """The fields of the parameters in the flat tensor, [K, …] each."""
        K = self.networks
        last = len(self.sizes) - 2
        fields: list[Field] = []
        for i in range(last + 1):
            inputs, outputs = self.sizes[i : i + 2]
            if self.normalized is not Normalized.NOWHERE:
                fields += [Field(f"{i}.gain", (K, inputs, 1), 0), Field(f"{i}.shift", (K, inputs, 1), 0)]
            fields.append(Field(f"{i}.weight", (K, outputs, inputs), self.output_gain if i == last else math.sqrt(2)))
            if self.normalized is not Normalized.BEFORE or i == last:
                fields.append(Field(f"{i}.bias", (K, outputs, 1), 0))
        return fields

    def folded(self) -> MLPShape:
        """The shape of the plain MLPs that give the same outputs."""
        return self._replace(normalized=Normalized.NOWHERE, unit_rows=False)

    def statistics(self) -> list[Field]:
        """The fields of the running mean and variance of each normalization, [K, …] each; none without normalization."""
        if self.normalized is Normalized.NOWHERE:
            return []
        shapes = [(self.networks, size, 1) for size in self.sizes[:-1]]
        return [Field(f"{i}.{kind}", shape, 0) for i, shape in enumerate(shapes) for kind in ("mean", "variance")]


def initial(shape: MLPShape, generator: torch.Generator) -> Tensor:
    """Initial parameters [P]: orthogonal weights, gains of 1, and shifts and biases of 0."""
    fields = shape.fields()
    flat = torch.zeros(total_size(fields), dtype=DTYPE)
    for field, view in zip(fields, named_views(flat, fields).values(), strict=True):
        if field.name.endswith("gain"):
            view.fill_(1)
        elif field.name.endswith("weight"):
            for weight in view:
                torch.nn.init.orthogonal_(weight, field.gain, generator)
    return flat


def initial_statistics(shape: MLPShape) -> Tensor:
    """Initial running statistics [S]: means of 0 and variances of 1."""
    flat = torch.zeros(total_size(shape.statistics()), dtype=DTYPE)
    for name, view in named_views(flat, shape.statistics()).items():
        view.fill_(float(name.endswith("variance")))
    return flat


class StackedMLPs:
    """K MLPs with the same shape. The caller owns their flat tensors: parameters [P] and running statistics [S]."""

    def __init__(self, shape: MLPShape, parameters: Tensor, statistics: Tensor) -> None:
        """`parameters` is a leaf of autograd's graph. `statistics` (see `initial_statistics`) are changed in place."""
        self.shape = shape
        self._fields = shape.fields()
        self._folded_fields = shape.folded().fields()
        self._trained = parameters
        self._constant = parameters.detach()
        named = named_views(statistics, shape.statistics())
        norms = len(named) // 2
        self._running = [RunningStatistics(named[f"{i}.mean"], named[f"{i}.variance"]) for i in range(norms)]
        self._plan = Plan(self._layers, shape.relu, shape.normalized is Normalized.BEFORE)
        self._normalizes = norms > 0
        self._now = self._layers(self._constant) if self._normalizes else []

    def trained(self, x: Tensor, *, renormalizes: bool = False) -> Tensor:
        """Outputs [K, B, O] for rows [B, D]. The parameters get a gradient, and running statistics move."""
        if not self._normalizes:
            return self._plain(x, self._trained)
        out: Tensor = NormalizedPass.apply(x, self._trained, self._plan, self._running, renormalizes)  # type: ignore[no-untyped-call]
        return out

    def of_minibatch(self, x: Tensor) -> Tensor:
        """Like `trained`, but for target networks: no renormalization, no gradient, and running statistics don't move."""
        if not self._normalizes:
            return self._plain(x, self._constant)
        out: Tensor = NormalizedPass.apply(x, self._constant, self._plan, None, False)  # type: ignore[no-untyped-call]
        return out

    def evaluated(self, x: Tensor) -> Tensor:
        """Outputs [K, B, O] for rows [B, D], normalized by the running statistics. Only x gets a gradient."""
        return self._plain(x, self.folded())

    @torch.no_grad()
    def folded(self) -> Tensor:
        """Parameters [P′] of plain MLPs that give the outputs of `evaluated`: weights and biases by layer, [K, …] each."""
        if not self._normalizes:
            return self._constant
        flat = self._constant.new_zeros(total_size(self._folded_fields))
        into = named_views(flat, self._folded_fields)
        scales, shifts = zip(*map(_linear, self._now, self._running), strict=True)
        for i, layer in enumerate(self._now):
            weight = into[f"{i}.weight"]
            bias = into[f"{i}.bias"]
            weight.copy_(layer.weight)
            if layer.bias is not None:
                bias.copy_(layer.bias)
            if i == 0 or not self._plan.before:
                bias.add_(weight @ shifts[i])
                weight.mul_(scales[i].mT)
            if i + 1 < len(scales) and self._plan.before:
                weight.mul_(scales[i + 1])
                bias.mul_(scales[i + 1]).add_(shifts[i + 1])
        return flat

    def _layers(self, flat: Tensor) -> list[Layer]:
        views = named_views(flat, self._fields)
        return [
            Layer(views[f"{i}.gain"], views[f"{i}.shift"], views[f"{i}.weight"], views.get(f"{i}.bias"))
            for i in range(len(self.shape.sizes) - 1)
        ]

    @torch.no_grad()
    def project(self) -> None:
        """With `unit_rows`, scale the weights of each unit to norm 1. Called after each optimizer step."""
        if self.shape.unit_rows:
            for name, view in named_views(self._constant, self._fields).items():
                if name.endswith("weight"):
                    view.div_(torch.linalg.vector_norm(view, dim=-1, keepdim=True))

    def _plain(self, x: Tensor, flat: Tensor) -> Tensor:
        """Outputs [K, B, O] of MLPs without normalization, with these parameters [P′]."""

        def layers_of(flat: Tensor) -> list[Tensor]:
            views = named_views(flat, self._folded_fields)
            return [view.squeeze(-1) if name.endswith("bias") else view for name, view in views.items()]

        out: Tensor = StackedMLPNode.apply(x, self.shape.relu, flat, layers_of)  # type: ignore[no-untyped-call]
        return out


def _linear(layer: Layer, running: RunningStatistics) -> tuple[Tensor, Tensor]:
    """The scale and the shift, [K, n, 1] each, that are equivalent to a normalization by running statistics."""
    scale = layer.gain * (running.variance + EPS).rsqrt()
    return scale, layer.shift - running.mean * scale
