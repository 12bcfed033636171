"""The networks of the learner in numpy: forward pass and gradient by hand, without autograd, on the flat parameters.

Rule: outputs and gradients are those of `protocol.policy.networks` and autograd, except for rounding, for every kind of
action. With a small network, torch spends most of the time of a minibatch on its graph, its dispatcher and its allocator,
not on arithmetic. Here an update is a few dozen calls on arrays that are reused. With a large network the matrix products
take most of the time, and torch is as fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from learner.algorithms.kernels.action_gradients import ActionGradients, action_gradients
from learner.algorithms.kernels.mlp import FusedMLP, Head, Linear
from protocol.arrays import Array
from protocol.policy.features import feature_size
from protocol.policy.layout import CRITICS, LOG_STD_BOUNDS, hidden_names, named_views, parameter_layout, total_size
from protocol.policy.masks import FORBIDDEN
from protocol.specs import PolicySpec

MAX_ROWS = 16_384  # rows of a minibatch: the arrays of a forward pass take memory
MAX_UNITS = 256  # units of a layer; in larger layers, matrix products take nearly all the time (`benchmarks.update`)


def can_fuse(spec: PolicySpec) -> bool:
    """True for policies that are only an MLP without large layers."""
    return not spec.needs_torch and spec.core is None and max((feature_size(spec), *spec.net)) <= MAX_UNITS


class FusedActorCritic:
    """Computes in numpy what `ActorCriticNetwork` computes in torch, on the same flat parameters and gradients."""

    def __init__(self, spec: PolicySpec, flat: Array, flat_grad: Array) -> None:
        """`flat`, `flat_grad`: [P], see `protocol.policy.layout`. `backward` writes `flat_grad`; others update `flat`."""
        values, grads = _views(spec, flat), _views(spec, flat_grad)
        trunks = [hidden_names(spec)] if spec.shared_net else [hidden_names(spec), hidden_names(spec, "critic")]
        hidden = [Linear.stacked(names, values, grads) for names in zip(*trunks, strict=True)]
        heads = [
            Head(Linear.stacked([name], values, grads), at)
            for name, at in (("actor.out", 0), ("critic.out", len(trunks) - 1))
        ]
        self._mlp = FusedMLP(hidden, heads, spec.activation == "relu")
        critic = [Linear.stacked([name], values, grads) for name in trunks[-1]]
        self._critic_mlp = FusedMLP(critic, [Head(heads[1].layer, 0)], spec.activation == "relu")
        self._actions: ActionGradients = action_gradients(
            spec.action, values.get("actor.log_std"), grads.get("actor.log_std")
        )

    def forward(self, x: Array, action: Array, mask: Array | None = None) -> tuple[Array, Array, Array]:
        """Features [B, D] and actions [B, *action] -> log π(action), the entropy of π, V: [B] each.

        `mask` [B, choices]: which actions are allowed. A logit that it forbids has probability 0, so the factor p makes its
        gradient 0 in `ActionGradients.backward`.
        """
        params, value = self._mlp.forward(x)
        if mask is not None:
            np.copyto(params, np.float32(FORBIDDEN), where=~mask.T)
        log_prob, entropy = self._actions.forward(params, action.reshape(len(x), -1))
        return log_prob, entropy, value[0]

    def backward(self, by_log_prob: Array, by_entropy: Array, by_value: Array) -> None:
        """Write the gradient of the loss with respect to every parameter.

        Arguments: its gradients [B] with respect to the outputs of the last `forward`.
        """
        self._mlp.backward((self._actions.backward(by_log_prob, by_entropy), by_value[None]))

    def value(self, x: Array) -> Array:
        """V [B] of features [B, D]. The next call overwrites it."""
        (value,) = self._critic_mlp.forward(x)
        found: Array = value[0]
        return found


class FusedQNetwork:
    """Computes in numpy what `QNetwork` computes in torch, on the same flat parameters and gradients."""

    def __init__(self, spec: PolicySpec, flat: Array, flat_grad: Array) -> None:
        """`flat`, `flat_grad`: [P], see `protocol.policy.layout`. `backward` writes `flat_grad`; others update `flat`."""
        values, grads = _views(spec, flat), _views(spec, flat_grad)
        hidden = [Linear.stacked([name], values, grads) for name in hidden_names(spec)]
        names = ("q.out", "q.value") if spec.dueling else ("q.out",)
        heads = [Head(Linear.stacked([name], values, grads), 0) for name in names]
        self._mlp = FusedMLP(hidden, heads, spec.activation == "relu")
        self._dueling = spec.dueling

    def forward(self, x: Array) -> Array:
        """Features [B, D] -> action values [n, B]. The next forward pass overwrites them."""
        advantage, *value = self._mlp.forward(x)
        if self._dueling:  # Q = V + A − mean A
            advantage += value[0] - _mean(advantage)
        return advantage

    def backward(self, gradient: Array) -> None:
        """Write the gradient of the loss with respect to every parameter.

        `gradient` [n, B]: its gradient with respect to the action values of the last `forward`.
        """
        if self._dueling:
            self._mlp.backward((gradient - _mean(gradient), np.add.reduce(gradient, 0, keepdims=True)))
        else:
            self._mlp.backward((gradient,))


class FusedActorAndCritics:
    """Computes in numpy what `ActorAndCritics` computes in torch, on the same flat parameters and gradients."""

    def __init__(self, spec: PolicySpec, flat: Array, flat_grad: Array) -> None:
        """`flat`, `flat_grad`: [P], see `protocol.policy.layout`; the layers before the last ones must not be none."""
        values, grads = _views(spec, flat), _views(spec, flat_grad)
        relu = spec.activation == "relu"
        names = hidden_names(spec)
        self._clips = spec.head == "squashed"
        actor = [Linear.stacked([name], values, grads) for name in names]
        self._actor = FusedMLP(actor, [Head(Linear.stacked(["actor.out"], values, grads), 0)], relu)

        def critics(names: Sequence[str]) -> FusedMLP:
            trunks = [hidden_names(spec, critic) for critic in names]
            layers = [Linear.stacked(each, values, grads) for each in zip(*trunks, strict=True)]
            heads = [Head(Linear.stacked([f"{critic}.out"], values, grads), i) for i, critic in enumerate(names)]
            return FusedMLP(layers, heads, relu)

        self._critics = {count: critics(CRITICS[:count]) for count in (1, len(CRITICS))}
        self._features = feature_size(spec)

    def params(self, x: Array) -> Array:
        """Features [B, D] -> the actor's output [P, B], as `ActorAndCritics.params`. The next call overwrites it."""
        (params,) = self._actor.forward(x)
        if self._clips:
            log_std = params[len(params) // 2 :]
            low, high = LOG_STD_BOUNDS
            self._inside = (log_std >= low) & (log_std <= high)
            np.clip(log_std, low, high, out=log_std)
        return params

    def actor_backward(self, by_params: Array) -> None:
        """Write the gradient of the actor. `by_params` [P, B]: the loss's gradient by the last `params`; it is changed."""
        if self._clips:
            by_params[len(by_params) // 2 :] *= self._inside
        self._actor.backward((by_params,))

    def values(self, x: Array, action: Array, critics: int = len(CRITICS)) -> Array:
        """Features [B, D] and actions [B, D′] -> the values [critics, B] of both critics, or of the first."""
        return np.concatenate(self._critics[critics].forward(np.concatenate((x, action), 1)))

    def critics_backward(self, by_values: Array) -> None:
        """Write the gradient of both critics. `by_values` [2, B]: the loss's gradient by the last `values`."""
        self._critics[len(CRITICS)].backward((by_values[:1], by_values[1:]))

    def action_gradient(self, by_values: Array) -> Array:
        """The loss's gradient [D′, B] by the actions of the last `values` of so many critics, from that by these values."""
        by_each = [by_values[i : i + 1] for i in range(len(by_values))]
        return self._critics[len(by_values)].input_gradient(by_each)[self._features :]


def _mean(array: Array) -> Array:
    """[n, B] -> [B]."""
    found: Array = np.add.reduce(array, 0) / len(array)
    return found


def _views(spec: PolicySpec, flat: Array) -> dict[str, Array]:
    fields: Sequence[Any] = sum(parameter_layout(spec), ())
    assert len(flat) == total_size(fields)
    return named_views(flat, fields)
