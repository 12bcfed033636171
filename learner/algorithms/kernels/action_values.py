"""Action values of a minibatch and their gradient: with a graph, or without one where layers are all there is and small.

The law: both give the same numbers, to rounding. Which one is used depends on the policy, the device and the size of the
minibatch, never on time. Each has its own kind of array (tensors, or numpy's), which it makes and reads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from learner.algorithms.kernels import fused
from protocol.arrays import Array
from protocol.policy.networks import QNetwork


class ActionValues(Protocol):
    """Of one network, for B rows: features [B, D] and images [B, *leaf] uint8 each."""

    def array(self, array: Array) -> Any:
        """An array [B] of the kind that is used here."""
        ...

    def best(self, x: Array, images: Sequence[Array]) -> Any:
        """The best actions [B]."""
        ...

    def of(self, x: Array, images: Sequence[Array], action: Any) -> Any:
        """The values [B] of these actions [B]; `backward` goes back from the last ones."""
        ...

    def highest(self, x: Array, images: Sequence[Array]) -> Any:
        """The value [B] of the best actions."""
        ...

    def backward(self, gradient: Any) -> None:
        """From the gradient [B] by the last values to that of every parameter, in place."""
        ...

    def read(self, *numbers: Any) -> list[float]:
        """These numbers, and the length of the gradient."""
        ...


class WithGraph:
    """By autograd, on any device."""

    def __init__(self, net: QNetwork) -> None:
        self._net = net

    def array(self, array: Array) -> Tensor:
        """On the device of the weights."""
        return torch.from_numpy(array).to(self._net.flat.device)

    def _values(self, x: Array, images: Sequence[Array]) -> Tensor:
        return self._net.params(self.array(x), [self.array(image) for image in images])

    def best(self, x: Array, images: Sequence[Array]) -> Tensor:
        """See `ActionValues`."""
        with torch.no_grad():
            return self._values(x, images).argmax(1)

    def of(self, x: Array, images: Sequence[Array], action: Tensor) -> Tensor:
        """See `ActionValues`."""
        self._chosen = self._values(x, images).gather(1, action[:, None])[:, 0]
        return self._chosen.detach()

    def highest(self, x: Array, images: Sequence[Array]) -> Tensor:
        """See `ActionValues`."""
        with torch.no_grad():
            return self._values(x, images).amax(1)

    def backward(self, gradient: Tensor) -> None:
        """See `ActionValues`."""
        self._net.flat_grad.zero_()
        torch.autograd.backward(self._chosen, gradient)

    def read(self, *numbers: Tensor) -> list[float]:
        """See `ActionValues`."""
        found: list[float] = torch.stack((*numbers, self._net.flat_grad.norm())).tolist()
        return found


class WithoutGraph:
    """By `fused.py`, in numpy."""

    def __init__(self, net: QNetwork) -> None:
        self._gradient = net.flat_grad.numpy()
        self._net = fused.FusedQ(net.spec, net.flat.numpy(), self._gradient)

    def array(self, array: Array) -> Array:
        """As it is."""
        return array

    def best(self, x: Array, images: Sequence[Array]) -> Array:
        """See `ActionValues`."""
        return np.asarray(self._net.forward(x).argmax(0))

    def of(self, x: Array, images: Sequence[Array], action: Array) -> Array:
        """See `ActionValues`."""
        values = self._net.forward(x)
        self._shape, self._where = values.shape, action * len(x) + np.arange(len(x))
        return values.take(self._where)

    def highest(self, x: Array, images: Sequence[Array]) -> Array:
        """See `ActionValues`."""
        return np.asarray(np.maximum.reduce(self._net.forward(x), 0))

    def backward(self, gradient: Array) -> None:
        """See `ActionValues`."""
        by_value = np.zeros(self._shape, gradient.dtype)
        by_value.reshape(-1)[self._where] = gradient
        self._net.backward(by_value)

    def read(self, *numbers: Any) -> list[float]:
        """See `ActionValues`."""
        return [*map(float, numbers), math.sqrt(float(np.dot(self._gradient, self._gradient)))]


def action_values(net: QNetwork, rows: int) -> ActionValues:
    """What is faster for minibatches of so many rows."""
    small = net.flat.is_cpu and rows <= fused.MOST_ROWS and fused.applies(net.spec)
    return WithoutGraph(net) if small else WithGraph(net)
