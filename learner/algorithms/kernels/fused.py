"""Actor-critics and action values without a graph: forward and gradient by hand, in numpy, on the flat parameters.

The law: what comes out is what `protocol.policy.networks` and autograd give (to rounding), for every kind of action. A
minibatch of a small network spends its time on the graph, the dispatcher and the allocator, not on the arithmetic; here
there are a few dozen calls on arrays that are kept. Large networks' time is that of the products: there torch is as fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from learner.algorithms.kernels.action_gradients import Actions, actions
from learner.algorithms.kernels.mlp import Head, Layers, Linear
from protocol.arrays import Array
from protocol.policy.features import feature_size
from protocol.policy.layout import hidden_names, named_views, parameter_layout, total_size
from protocol.specs import PolicySpec

MOST_ROWS = 16_384  # of a minibatch: what is kept of one takes memory
MOST_UNITS = 256  # of a layer: above, the products are all that counts (`python -m benchmarks.update`)


def applies(spec: PolicySpec) -> bool:
    """True for policies that are layers, none of them large, and nothing else."""
    return not spec.needs_torch and spec.core is None and max((feature_size(spec), *spec.net)) <= MOST_UNITS


class FusedActorCritic:
    """`ActorCriticNetwork` on the same flat parameters and gradients."""

    def __init__(self, spec: PolicySpec, flat: Array, flat_grad: Array) -> None:
        """`flat`, `flat_grad`: [P] as `protocol.policy.layout` says, changed in place by others and by `backward`."""
        values, grads = _views(spec, flat), _views(spec, flat_grad)
        trunks = [hidden_names(spec)] if spec.shared_net else [hidden_names(spec), hidden_names(spec, "critic")]
        hidden = [Linear.of(names, values, grads) for names in zip(*trunks, strict=True)]
        heads = [
            Head(Linear.of([name], values, grads), at) for name, at in (("actor.out", 0), ("critic.out", len(trunks) - 1))
        ]
        self._layers = Layers(hidden, heads, spec.activation == "relu")
        critic = [Linear.of([name], values, grads) for name in trunks[-1]]
        self._critic = Layers(critic, [Head(heads[1].layer, 0)], spec.activation == "relu")
        self._actions: Actions = actions(spec.action, values.get("actor.log_std"), grads.get("actor.log_std"))

    def forward(self, x: Array, action: Array) -> tuple[Array, Array, Array]:
        """Features [B, D] and actions [B, *action] -> log π(action), the entropy of π, V: [B] each."""
        params, value = self._layers.forward(x)
        log_prob, entropy = self._actions.forward(params, action.reshape(len(x), -1))
        return log_prob, entropy, value[0]

    def backward(self, by_log_prob: Array, by_entropy: Array, by_value: Array) -> None:
        """From the gradients of the last forward pass's outputs [B] to that of every parameter, in place."""
        self._layers.backward((self._actions.backward(by_log_prob, by_entropy), by_value[None]))

    def value(self, x: Array) -> Array:
        """V [B] of features [B, D], alone; good until the next time."""
        (value,) = self._critic.forward(x)
        found: Array = value[0]
        return found


class FusedQ:
    """`QNetwork` on the same flat parameters and gradients."""

    def __init__(self, spec: PolicySpec, flat: Array, flat_grad: Array) -> None:
        """`flat`, `flat_grad`: [P] as `protocol.policy.layout` says, changed in place by others and by `backward`."""
        values, grads = _views(spec, flat), _views(spec, flat_grad)
        hidden = [Linear.of([name], values, grads) for name in hidden_names(spec)]
        names = ("q.out", "q.value") if spec.dueling else ("q.out",)
        heads = [Head(Linear.of([name], values, grads), 0) for name in names]
        self._layers = Layers(hidden, heads, spec.activation == "relu")
        self._dueling = spec.dueling

    def forward(self, x: Array) -> Array:
        """Features [B, D] -> action values [n, B]; good until the next forward pass."""
        advantage, *value = self._layers.forward(x)
        if self._dueling:  # Q = V + A − mean A
            advantage += value[0] - _mean(advantage)
        return advantage

    def backward(self, gradient: Array) -> None:
        """From the gradient by the last action values [n, B] to that of every parameter, in place."""
        if self._dueling:
            self._layers.backward((gradient - _mean(gradient), np.add.reduce(gradient, 0, keepdims=True)))
        else:
            self._layers.backward((gradient,))


def _mean(array: Array) -> Array:
    """[n, B] -> [B]."""
    found: Array = np.add.reduce(array, 0) / len(array)
    return found


def _views(spec: PolicySpec, flat: Array) -> dict[str, Array]:
    fields: Sequence[Any] = sum(parameter_layout(spec), ())
    assert len(flat) == total_size(fields)
    return named_views(flat, fields)
