"""The actor and the critics of SAC and TD3 on a minibatch, and their gradients: by autograd, or in numpy if they are small.

Rule: both give the same numbers, except for rounding. Which one is used depends on the policy, the device and the size of
the minibatch, never on time. Each has its own kind of array: torch tensors, or numpy arrays.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from learner.algorithms.kernels import fused
from protocol.arrays import Array
from protocol.policy.networks import ActorAndCritics


class ActorAndCriticsPasses(Protocol):
    """Forward and backward passes for B rows: features [B, D], and actions [B, D′] in [-1, 1]."""

    def to_array(self, array: Array) -> Any:
        """Convert a numpy array to the kind of array that this class uses, in the dtype of the weights."""
        ...

    def to_numpy(self, array: Any) -> Array:
        """Convert an array of that kind to a numpy array."""
        ...

    def params(self, x: Any) -> Any:
        """The actor's output [B, P]; see `ActorAndCritics.params`. `actor_backward` belongs to the last call."""
        ...

    def actor_backward(self, by_params: Any) -> None:
        """Write the gradient of the actor. The argument is the loss's gradient by the last `params` [B, P]."""
        ...

    def values(self, x: Any, action: Any) -> Any:
        """The values [2, B] of both critics; `critics_backward` may follow."""
        ...

    def values_by_action(self, x: Any, action: Any, critics: int) -> Any:
        """The values [critics, B] of both critics, or of the first; `action_gradient` may follow."""
        ...

    def critics_backward(self, by_values: Any) -> None:
        """Write the gradient of the critics. The argument is the loss's gradient by the last `values` [2, B]."""
        ...

    def action_gradient(self, by_values: Any) -> Any:
        """The loss's gradient [B, D′] by the actions of the last `values_by_action`, from that by its values."""
        ...


class AutogradPasses:
    """With autograd, on any device."""

    def __init__(self, net: ActorAndCritics) -> None:
        self._net = net

    def to_array(self, array: Array) -> Tensor:
        """See `ActorAndCriticsPasses`; on the device of the weights."""
        return torch.from_numpy(array).to(self._net.flat)

    def to_numpy(self, array: Tensor) -> Array:
        """See `ActorAndCriticsPasses`."""
        found: Array = array.cpu().numpy()
        return found

    def params(self, x: Tensor) -> Tensor:
        """See `ActorAndCriticsPasses`."""
        self._params = self._net.params(x)
        return self._params.detach()

    def actor_backward(self, by_params: Tensor) -> None:
        """See `ActorAndCriticsPasses`."""
        self._net.differentiate_actor(self._params, by_params)

    def values(self, x: Tensor, action: Tensor) -> Tensor:
        """See `ActorAndCriticsPasses`."""
        self._values = self._net.values(x, action)
        return self._values.detach()

    def values_by_action(self, x: Tensor, action: Tensor, critics: int) -> Tensor:
        """See `ActorAndCriticsPasses`."""
        self._action = action.detach().requires_grad_()
        self._values = self._net.values(x, self._action, constant=True, critics=critics)
        return self._values.detach()

    def critics_backward(self, by_values: Tensor) -> None:
        """See `ActorAndCriticsPasses`."""
        self._net.differentiate_critics(self._values, by_values)

    def action_gradient(self, by_values: Tensor) -> Tensor:
        """See `ActorAndCriticsPasses`."""
        (found,) = torch.autograd.grad(self._values, self._action, by_values)
        return found


class FusedPasses:
    """In numpy, by `FusedActorAndCritics`. Arrays [B, P] are views of arrays [P, B]."""

    def __init__(self, net: ActorAndCritics) -> None:
        self._net = fused.FusedActorAndCritics(net.spec, net.flat.numpy(), net.flat_grad.numpy())
        self._dtype = net.flat.numpy().dtype

    def to_array(self, array: Array) -> Array:
        """See `ActorAndCriticsPasses`."""
        return array.astype(self._dtype, copy=False)

    def to_numpy(self, array: Array) -> Array:
        """See `ActorAndCriticsPasses`."""
        return array

    def params(self, x: Array) -> Array:
        """See `ActorAndCriticsPasses`. The next call overwrites it."""
        return self._net.params(x).T

    def actor_backward(self, by_params: Array) -> None:
        """See `ActorAndCriticsPasses`. Changes its argument."""
        self._net.actor_backward(by_params.T)

    def values(self, x: Array, action: Array) -> Array:
        """See `ActorAndCriticsPasses`."""
        return self._net.values(x, action)

    def values_by_action(self, x: Array, action: Array, critics: int) -> Array:
        """See `ActorAndCriticsPasses`."""
        return self._net.values(x, action, critics)

    def critics_backward(self, by_values: Array) -> None:
        """See `ActorAndCriticsPasses`."""
        self._net.critics_backward(by_values)

    def action_gradient(self, by_values: Array) -> Array:
        """See `ActorAndCriticsPasses`. The next call overwrites it."""
        return self._net.action_gradient(by_values).T


def passes_of(net: ActorAndCritics, rows: int) -> ActorAndCriticsPasses:
    """The faster of the two implementations for minibatches of `rows` rows."""
    small = net.flat.is_cpu and rows <= fused.MAX_ROWS and fused.can_fuse(net.spec) and len(net.spec.net) > 0
    return FusedPasses(net) if small else AutogradPasses(net)
