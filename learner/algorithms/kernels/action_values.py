"""Action values of a minibatch and their gradient: by autograd, or in numpy if the network is a small MLP on the CPU.

Rule: both give the same numbers, except for rounding. Which one is used depends on the policy, the device and the size of
the minibatch, never on time. Each has its own kind of array: torch tensors, or numpy arrays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from learner.algorithms.kernels import fused
from protocol.arrays import Array, Bools
from protocol.policy.masks import FORBIDDEN
from protocol.policy.networks import QNetwork


class ActionValues(Protocol):
    """The action values of one network, for B rows: features [B, D] and images [B, *leaf] uint8 each."""

    def to_array(self, array: Array) -> Any:
        """Convert a numpy array [B] to the kind of array that this class uses."""
        ...

    def best_actions(self, x: Array, images: Sequence[Array], mask: Bools | None = None) -> Any:
        """The best actions [B], among those that `mask` [B, n] allows."""
        ...

    def chosen(self, x: Array, images: Sequence[Array], action: Any) -> Any:
        """The values [B] of these actions [B]. `backward` belongs to the last call."""
        ...

    def best_values(self, x: Array, images: Sequence[Array], mask: Bools | None = None) -> Any:
        """The values [B] of the best actions, among those that `mask` [B, n] allows."""
        ...

    def backward(self, gradient: Any) -> None:
        """Write the gradient of every parameter. The argument is the loss's gradient [B] of the last values of `chosen`."""
        ...

    def numbers_and_norm(self, *numbers: Any) -> list[float]:
        """These numbers as floats, and the norm of the gradient."""
        ...


class AutogradActionValues:
    """Action values with autograd, on any device."""

    def __init__(self, net: QNetwork) -> None:
        self._net = net

    def to_array(self, array: Array) -> Tensor:
        """See `ActionValues`; on the device of the weights."""
        return torch.from_numpy(array).to(self._net.flat.device)

    def _values(self, x: Array, images: Sequence[Array]) -> Tensor:
        return self._net.params(self.to_array(x), [self.to_array(image) for image in images])

    def best_actions(self, x: Array, images: Sequence[Array], mask: Bools | None = None) -> Tensor:
        """See `ActionValues`."""
        with torch.no_grad():
            return self._allowed_values(x, images, mask).argmax(1)

    def _allowed_values(self, x: Array, images: Sequence[Array], mask: Bools | None) -> Tensor:
        values = self._values(x, images)
        return values if mask is None else values.masked_fill(~self.to_array(mask), FORBIDDEN)

    def chosen(self, x: Array, images: Sequence[Array], action: Tensor) -> Tensor:
        """See `ActionValues`."""
        self._chosen = self._values(x, images).gather(1, action[:, None])[:, 0]
        return self._chosen.detach()

    def best_values(self, x: Array, images: Sequence[Array], mask: Bools | None = None) -> Tensor:
        """See `ActionValues`."""
        with torch.no_grad():
            return self._allowed_values(x, images, mask).amax(1)

    def backward(self, gradient: Tensor) -> None:
        """See `ActionValues`."""
        self._net.flat_grad.zero_()
        torch.autograd.backward(self._chosen, gradient)

    def numbers_and_norm(self, *numbers: Tensor) -> list[float]:
        """See `ActionValues`."""
        found: list[float] = torch.stack((*numbers, self._net.flat_grad.norm())).tolist()
        return found


class FusedActionValues:
    """Action values in numpy, by `FusedQNetwork`."""

    def __init__(self, net: QNetwork) -> None:
        self._gradient = net.flat_grad.numpy()
        self._net = fused.FusedQNetwork(net.spec, net.flat.numpy(), self._gradient)

    def to_array(self, array: Array) -> Array:
        """See `ActionValues`."""
        return array

    def best_actions(self, x: Array, images: Sequence[Array], mask: Bools | None = None) -> Array:
        """See `ActionValues`."""
        return np.asarray(self._allowed_values(x, mask).argmax(0))

    def _allowed_values(self, x: Array, mask: Bools | None) -> Array:
        values = self._net.forward(x)  # [n, B]
        if mask is not None:
            np.copyto(values, np.float32(FORBIDDEN), where=~mask.T)
        return values

    def chosen(self, x: Array, images: Sequence[Array], action: Array) -> Array:
        """See `ActionValues`."""
        values = self._net.forward(x)
        self._shape, self._where = values.shape, action * len(x) + np.arange(len(x))
        return values.take(self._where)

    def best_values(self, x: Array, images: Sequence[Array], mask: Bools | None = None) -> Array:
        """See `ActionValues`."""
        return np.asarray(np.maximum.reduce(self._allowed_values(x, mask), 0))

    def backward(self, gradient: Array) -> None:
        """See `ActionValues`."""
        by_value = np.zeros(self._shape, gradient.dtype)
        by_value.reshape(-1)[self._where] = gradient
        self._net.backward(by_value)

    def numbers_and_norm(self, *numbers: Any) -> list[float]:
        """See `ActionValues`."""
        return [*map(float, numbers), math.sqrt(float(np.dot(self._gradient, self._gradient)))]


def action_values(net: QNetwork, rows: int) -> ActionValues:
    """The faster of the two implementations for minibatches of `rows` rows."""
    small = net.flat.is_cpu and rows <= fused.MAX_ROWS and fused.can_fuse(net.spec)
    return FusedActionValues(net) if small else AutogradActionValues(net)
