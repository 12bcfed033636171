"""Layers without a graph: some MLPs side by side, forward and back, on arrays that are kept from one minibatch to the next.

The law: outputs and gradients are those of the formulas below, to rounding; how rows are cut into pieces depends on their
number alone, so the same minibatch gives the same bits.

Arrays are [S, n, B]: S networks side by side, a column for each row of the minibatch, so that inner loops are long. A piece
of the rows goes all the way forward, or back, while it is in the cache. With g = ∂L/∂(pre-activation): ∂L/∂W = g hᵀ,
∂L/∂b = Σ g, ∂L/∂h = Wᵀ g; φ' is 1 − h² (tanh) or h > 0 (ReLU).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided

from protocol.arrays import Array

Call = Callable[[], object]

PIECE = 512  # rows, at most
LARGE = 64 * 64 * 128  # multiplications of one product: from here torch's are faster than numpy's
KEPT = 256  # sizes of minibatch: rows that are not valid make them change


class Linear(NamedTuple):
    """Layers of the same shape in S networks, and where their gradients go: views into flat arrays."""

    weight: Array  # [S, out, in]
    bias: Array  # [S, out, 1]
    weight_grad: Array  # [S, out, in]
    bias_grad: Array  # [S, out]

    @staticmethod
    def of(names: Sequence[str], values: Mapping[str, Array], grads: Mapping[str, Array]) -> Linear:
        """One layer of each of one or two networks, by name."""
        weight, bias, weight_grad, bias_grad = (
            _side_by_side([of[f"{name}.{kind}"] for name in names]) for of in (values, grads) for kind in ("weight", "bias")
        )
        return Linear(weight, bias[..., None], weight_grad, bias_grad)


class Head(NamedTuple):
    """A linear layer on one of the networks."""

    layer: Linear
    network: int


class Layers:
    """MLPs of the same shape that see the same features, and linear heads on them."""

    def __init__(self, hidden: Sequence[Linear], heads: Sequence[Head], relu: bool) -> None:
        self._hidden, self._heads, self._relu = hidden, heads, relu
        self._memory = _Memory(heads[0].layer.weight)
        self._passes: dict[int, _Pass] = {}

    def forward(self, x: Array) -> list[Array]:
        """Features [B, D] -> what each head says, [out, B]; good until the next forward pass."""
        made = self._passes.get(len(x))
        if made is None:
            if len(self._passes) == KEPT:
                self._passes.clear()
            self._memory.begin_again()
            made = self._passes[len(x)] = _Pass(len(x), self._hidden, self._heads, self._relu, self._memory)
        self._last = made
        for piece in made.pieces:
            piece.x[0] = x[piece.rows].T
            for call in piece.forward:
                call()
        return [said[0] for said in made.said]

    def backward(self, gradients: Sequence[Array]) -> None:
        """From the gradients of the last forward pass's outputs [out, B] to those of all layers, in place."""
        for given, by_said in zip(gradients, self._last.by_said, strict=True):
            by_said[0] = given
        for piece in self._last.pieces:
            for call in piece.back_from_heads + piece.back_through_hidden:
                call()
        for call in self._last.gather:
            call()


class _Memory:
    """Arrays that passes of all sizes share, for there is one pass at a time: each takes the same ones in the same order."""

    def __init__(self, like: Array) -> None:
        self._like = like
        self._arrays: list[Array] = []
        self._taken = 0

    def begin_again(self) -> None:
        """The next array is the first."""
        self._taken = 0

    def take(self, *shape: int) -> Array:
        """The next array, C-ordered, whatever is in it."""
        size, number = math.prod(shape), self._taken
        self._taken += 1
        if number == len(self._arrays):
            self._arrays.append(np.empty(0, self._like.dtype))
        if self._arrays[number].size < size:
            # By torch, which aligns arrays always alike: its products could give other bits where they are not. To a power
            # of two, lest every size that is a little larger takes memory of its own.
            room = 1 << (size - 1).bit_length()
            self._arrays[number] = torch.zeros(room, dtype=torch.from_numpy(self._like).dtype).numpy()
        return self._arrays[number][:size].reshape(shape)

    def outputs(self, layer: Linear, rows: int) -> Array:
        """For what a layer says, [S, out, B]."""
        return self.take(*layer.bias_grad.shape, rows)


class _Pass:
    """What is done with so many rows: pieces of them, one after another, then one gradient of those of the pieces."""

    def __init__(self, rows: int, hidden: Sequence[Linear], heads: Sequence[Head], relu: bool, memory: _Memory) -> None:
        count = -(-rows // PIECE)
        self._memory = memory
        self.said = [memory.outputs(head.layer, rows) for head in heads]
        self.by_said = [memory.outputs(head.layer, rows) for head in heads]
        self.gather: list[Call] = []
        trunk = [self._for_each(layer, count) for layer in hidden]
        tops = [self._for_each(head.layer, count) for head in heads]
        # One for all pieces, to stay in the cache.
        gradients = [memory.outputs(layer, -(-rows // count)) for layer in hidden]
        self.pieces: list[_Piece] = []
        for i in range(count):
            its = slice(rows * i // count, rows * (i + 1) // count)
            piece = _Piece(its, (trunk or tops)[0][i], memory)
            for layer, dy in zip(trunk, gradients, strict=True):
                piece.hide(layer[i], dy[..., : its.stop - its.start], relu)
            for layer, head, said, by_said in zip(tops, heads, self.said, self.by_said, strict=True):
                piece.say(layer[i], head.network, said[..., its], by_said[..., its])
            self.pieces.append(piece)

    def _for_each(self, layer: Linear, count: int) -> list[Linear]:
        """The same layer for each piece, each with a gradient of its own."""
        if count == 1:
            return [layer]
        weight, bias = (self._memory.take(count, *grad.shape) for grad in (layer.weight_grad, layer.bias_grad))
        self.gather += [partial(np.add.reduce, weight, 0, out=layer.weight_grad)]
        self.gather += [partial(np.add.reduce, bias, 0, out=layer.bias_grad)]
        return [layer._replace(weight_grad=weight[i], bias_grad=bias[i]) for i in range(count)]


class _Piece:
    """Some of the rows: what they are, and the calls, made ready in their order."""

    def __init__(self, rows: slice, first: Linear, memory: _Memory) -> None:
        self.rows = rows
        self._memory = memory
        self.x = self._h = memory.take(1, first.weight.shape[2], rows.stop - rows.start)
        self._dh: Array | None = None  # the gradient by the last hidden layers
        self._given: set[int] = set()  # networks that have one from a head
        self._ones = np.ones(rows.stop - rows.start, first.weight.dtype)
        self.forward: list[Call] = []
        self.back_from_heads: list[Call] = []
        self.back_through_hidden: list[Call] = []

    def hide(self, layer: Linear, dy: Array, relu: bool) -> None:
        """One more hidden layer; `dy`: where the gradient by what it says will be."""
        y = self._memory.outputs(layer, len(self._ones))
        self.forward += [*_linear(layer, self._h, y), _activation(y, relu)]
        self.back_through_hidden[:0] = [_slope(dy, y, relu), *self._back(layer, self._h, dy, self._dh)]
        self._h, self._dh = y, dy

    def say(self, layer: Linear, network: int, y: Array, dy: Array) -> None:
        """One more head, after all hidden layers."""
        its = slice(None) if self._dh is None else slice(network, network + 1)
        dh = None if self._dh is None else self._dh[its]
        self.forward += _linear(layer, self._h[its], y)
        if dh is None or network not in self._given:
            self.back_from_heads += self._back(layer, self._h[its], dy, dh)
        else:
            more = self._memory.take(*dh.shape)
            self.back_from_heads += [*self._back(layer, self._h[its], dy, more), partial(np.add, dh, more, out=dh)]
        self._given.add(network)

    def _back(self, layer: Linear, x: Array, dy: Array, dx: Array | None) -> list[Call]:
        """From `dy` to the gradients of a layer, and to `dx` if it is wanted."""
        calls: list[Call] = [
            _product(dy, x.swapaxes(1, 2), layer.weight_grad),
            partial(np.matmul, dy, self._ones, out=layer.bias_grad),
        ]
        return calls if dx is None else [*calls, _product(layer.weight.swapaxes(1, 2), dy, dx)]


def _linear(layer: Linear, x: Array, y: Array) -> list[Call]:
    out = torch.from_numpy(y)
    return [_product(layer.weight, x, y), partial(torch.add, out, torch.from_numpy(layer.bias), out=out)]


def _activation(y: Array, relu: bool) -> Call:
    """In place."""
    return partial(np.maximum, y, 0, out=y) if relu else partial(np.tanh, y, out=y)


def _slope(dy: Array, y: Array, relu: bool) -> Call:
    """The gradient before the activation, in place."""
    to, of = torch.from_numpy(dy), torch.from_numpy(y)
    if relu:
        return partial(torch.ops.aten.threshold_backward.grad_input, to, of, 0, grad_input=to)
    return partial(torch.ops.aten.tanh_backward.grad_input, to, of, grad_input=to)


def _product(a: Array, b: Array, out: Array) -> Call:
    """What computes `out` = a b, [S, n, k] by [S, k, m], whenever it is called."""
    networks, n, k = out.shape[0], *a.shape[1:]
    if k > 1 and n * k * b.shape[2] < LARGE:
        return partial(np.matmul, a, b, out=out)
    one, other, result = map(torch.from_numpy, (a, b, out))
    if k == 1:
        return partial(torch.mul, one, other, out=result)
    return partial(torch.bmm, one, other.expand(networks, -1, -1), out=result)


def _side_by_side(arrays: Sequence[Array]) -> Array:
    """One or two views of the same shape into the same array, as one view [S, *shape]."""
    first, last = arrays[0], arrays[-1]
    apart = last.__array_interface__["data"][0] - first.__array_interface__["data"][0]
    return as_strided(first, (len(arrays), *first.shape), (apart, *first.strides))
