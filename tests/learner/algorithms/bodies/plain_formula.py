"""MLPs with batch normalization as a formula that autograd differentiates: one network at a time, one line a rule."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.stacked_mlps import MLPShape, Normalized

EPS = 1e-3


class PlainLayer(NamedTuple):
    """A linear layer of one network, and the normalization in front of it."""

    gain: Tensor
    """[in]"""
    shift: Tensor
    """[in]"""
    weight: Tensor
    """[out, in]"""
    bias: Tensor
    """[out]"""


class Statistics(NamedTuple):
    """Of one normalization of one network, [n] each."""

    mean: Tensor
    variance: Tensor


def layers(shape: MLPShape, flat: Tensor) -> list[list[PlainLayer]]:
    """The layers of each network, in the order in which the flat parameters hold them."""
    K, at, found = shape.networks, 0, list[list[PlainLayer]]()

    def taken(*size: int) -> Tensor:
        nonlocal at
        count = int(torch.Size((K, *size)).numel())
        at += count
        return flat[at - count : at].reshape(K, *size)

    last = len(shape.sizes) - 2
    for i, (inputs, outputs) in enumerate(zip(shape.sizes[:-1], shape.sizes[1:], strict=True)):
        normalizes = shape.normalized is not Normalized.NOWHERE
        gain, shift = (taken(inputs), taken(inputs)) if normalizes else (flat.new_ones(K, inputs), flat.new_zeros(K, inputs))
        weight = taken(outputs, inputs)
        has_bias = i == last or shape.normalized is not Normalized.BEFORE
        bias = taken(outputs) if has_bias else flat.new_zeros(K, outputs)
        found.append([PlainLayer(*parts) for parts in zip(gain, shift, weight, bias, strict=True)])
    assert at == len(flat)
    return [list(network) for network in zip(*found, strict=True)]


def every_layer(shape: MLPShape, flat: Tensor) -> list[PlainLayer]:
    """Those of the first network, then those of the next."""
    return [layer for network in layers(shape, flat) for layer in network]


def statistics(shape: MLPShape, flat: Tensor) -> list[list[Statistics]]:
    """The running statistics of each network: none if it does not normalize."""
    if shape.normalized is Normalized.NOWHERE:
        return [[] for _ in range(shape.networks)]
    sizes = [shape.networks * size for size in shape.sizes[:-1] for _ in range(2)]
    views = [part.view(shape.networks, -1) for part in torch.split(flat, sizes)]
    pairs = list(zip(views[::2], views[1::2], strict=True))
    return [[Statistics(mean[k], variance[k]) for mean, variance in pairs] for k in range(shape.networks)]


def of_minibatch(h: Tensor, layer: PlainLayer, _: Any) -> Tensor:
    """γ (h − μ) / σ + β for h [B, n], with the mean and the variance of these rows."""
    return layer.gain * (h - h.mean(0)) / (h.var(0, correction=0) + EPS).sqrt() + layer.shift


def evaluated(h: Tensor, layer: PlainLayer, running: Statistics) -> Tensor:
    """The same with running statistics."""
    return layer.gain * (h - running.mean) / (running.variance + EPS).sqrt() + layer.shift


def renormalized(h: Tensor, layer: PlainLayer, running: Statistics) -> Tensor:
    """γ (r (h − μ) / σ + d) + β, where r and d are constants within bounds (Ioffe 2017)."""
    std, running_std = (h.var(0, correction=0) + EPS).sqrt(), (running.variance + EPS).sqrt()
    r = (std / running_std).detach().clamp(1 / 3, 3)
    d = ((h.mean(0) - running.mean) / running_std).detach().clamp(-5, 5)
    return layer.gain * (r * (h - h.mean(0)) / std + d) + layer.shift


def outputs(
    shape: MLPShape, flat: Tensor, x: Tensor, normalize: Any = of_minibatch, running: Tensor | None = None
) -> Tensor:
    """Outputs [K, B, O] of rows [B, D]. `running`: flat statistics, for a way to normalize that needs them."""
    return torch.stack([out for out, _ in passes(shape, flat, x, normalize, running)])


def passes(
    shape: MLPShape, flat: Tensor, x: Tensor, normalize: Any = of_minibatch, running: Tensor | None = None
) -> list[tuple[Tensor, list[Tensor]]]:
    """Of each network, its outputs [B, O], and what each normalization was given, [B, n]."""
    nothing = [[None] * len(shape.sizes)] * shape.networks
    known: Any = nothing if running is None else statistics(shape, running)
    activation = torch.relu if shape.relu else torch.tanh
    found = list[tuple[Tensor, list[Tensor]]]()
    for network, of_network in zip(layers(shape, flat), known, strict=True):
        h, given = x, list[Tensor]()
        for i, layer in enumerate(network):
            if i and shape.normalized is not Normalized.BEFORE:
                h = activation(h)
            if shape.normalized is not Normalized.NOWHERE:
                given.append(h)
                h = normalize(h, layer, of_network[i])
            if i and shape.normalized is Normalized.BEFORE:
                h = activation(h)
            h = h @ layer.weight.T + layer.bias
        found.append((h, given))
    return found
