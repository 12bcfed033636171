"""Forward pass and gradient of an MLP actor-critic without a graph: numpy kernels on the flat parameters, in place.

The law: what comes out is what `protocol.networks.ActorCritic` and autograd give (to rounding), for every kind of action.
A small minibatch spends its time on the graph, the dispatcher and the allocator, not on the arithmetic; here there are a
few dozen calls on arrays that are kept from one minibatch to the next. Where the matrix products dominate, torch is as fast.

With g = ∂L/∂(pre-activation): ∂L/∂W = gᵀ h, ∂L/∂b = Σ g, ∂L/∂h = g W; φ' is 1 − h² (tanh) or h > 0 (ReLU).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.distributions import LOG_SQRT_2PI
from protocol.policy import hidden_names, layout, size, views
from protocol.specs import ActionSpec, PolicySpec

Array = npt.NDArray[Any]

MOST_ROWS = 512  # of a minibatch: above, torch's products win (`python -m benchmarks.update`)


def applies(spec: PolicySpec) -> bool:
    """True for policies that are layers and nothing else."""
    return spec.head == "actor_critic" and not spec.needs_torch and spec.core is None


class _Layer(NamedTuple):
    """A linear layer, and where its gradient goes."""

    weight: Array  # [out, in]
    bias: Array  # [out]
    weight_grad: Array
    bias_grad: Array


class _Pass:
    """Some layers, one after another, and what they left behind for the way back."""

    def __init__(self, layers: Sequence[_Layer], relu: bool, head: bool) -> None:
        """`head`: the last layer is linear, and has no activation."""
        self._layers, self._relu, self._head = layers, relu, head
        self._kept: dict[int, list[Array]] = {}  # by the number of rows: outputs, and their gradients

    def _buffers(self, rows: int, x: Array) -> list[Array]:
        if rows not in self._kept:
            if len(self._kept) > 8:  # minibatches have two sizes, and the last rollouts of a run perhaps others
                self._kept.clear()
            self._kept[rows] = [np.empty((rows, len(layer.bias)), x.dtype) for layer in self._layers for _ in range(2)]
        return self._kept[rows]

    def forward(self, x: Array) -> Array:
        """[B, in] -> [B, out]; good until the next forward pass of as many rows."""
        kept = self._buffers(len(x), x)
        self._x = x
        last = len(self._layers) - 1
        for i, layer in enumerate(self._layers):
            h = kept[2 * i]
            np.matmul(x, layer.weight.T, out=h)
            h += layer.bias
            if i < last or not self._head:
                if self._relu:
                    np.maximum(h, 0, out=h)
                else:
                    np.tanh(h, out=h)
            x = h
        return x

    def backward(self, g: Array, wanted: bool) -> Array:
        """∂L/∂output [B, out], which is used up -> gradients of the layers, and ∂L/∂x if it is `wanted`."""
        kept = self._kept[len(g)]
        last = len(self._layers) - 1
        for i in range(last, -1, -1):
            layer = self._layers[i]
            if i < last or not self._head:
                h, slope = kept[2 * i], kept[2 * i + 1]
                if self._relu:
                    g *= h > 0
                else:
                    np.multiply(h, h, out=slope)
                    np.subtract(1, slope, out=slope)
                    g *= slope
            np.matmul(g.T, kept[2 * i - 2] if i else self._x, out=layer.weight_grad)
            np.add.reduce(g, 0, out=layer.bias_grad)
            if i or wanted:
                g = np.matmul(g, layer.weight)
        return g


class FusedActorCritic:
    """`ActorCritic` on the same flat parameters and gradients."""

    def __init__(self, spec: PolicySpec, flat: Array, flat_grad: Array) -> None:
        """`flat`, `flat_grad`: [P] as `protocol.policy.layout` says, changed in place by others and by `backward`."""
        self.spec = spec
        acting, critic = layout(spec)
        fields = (*acting, *critic)
        assert len(flat) == size(fields)
        values, grads = views(flat, fields), views(flat_grad, fields)

        def layers(names: Sequence[str]) -> list[_Layer]:
            kinds = ("weight", "bias")
            return [_Layer(*(of[f"{name}.{kind}"] for of in (values, grads) for kind in kinds)) for name in names]

        relu, trunk = spec.activation == "relu", hidden_names(spec)
        self._trunk = _Pass(layers(trunk), relu, head=False) if spec.shared_net and trunk else None
        own = ([], []) if spec.shared_net else (trunk, hidden_names(spec, "critic"))
        self._actor = _Pass(layers([*own[0], "actor.out"]), relu, head=True)
        self._critic = _Pass(layers([*own[1], "critic.out"]), relu, head=True)
        self._action: _Action = _action(spec.action, values.get("actor.log_std"), grads.get("actor.log_std"))

    def forward(self, x: Array, action: Array) -> tuple[Array, Array, Array]:
        """Features [B, D] and actions [B, *action] -> log π(action), the entropy of π, V: [B] each."""
        h = x if self._trunk is None else self._trunk.forward(x)
        log_prob, entropy = self._action.forward(self._actor.forward(h), action.reshape(len(x), -1))
        return log_prob, entropy, self._critic.forward(h)[:, 0]

    def backward(self, by_log_prob: Array, by_entropy: Array, by_value: Array) -> None:
        """From the gradients of the last forward pass's outputs [B] to that of every parameter, in place."""
        shared = self._trunk is not None
        found = self._actor.backward(self._action.backward(by_log_prob, by_entropy), wanted=shared)
        from_value = self._critic.backward(by_value[:, None].copy(), wanted=shared)
        if self._trunk is not None:
            found += from_value
            self._trunk.backward(found, wanted=False)


class _Action:
    """A distribution over actions: forward keeps what backward needs."""

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        """Parameters [B, P] and actions [B, k] -> log π(action) [B], entropy [B]."""
        raise NotImplementedError

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        """∂L/∂parameters [B, P]."""
        raise NotImplementedError


class _Categorical(_Action):
    """∂log π(a)/∂logits = 1ₐ − p;  ∂H/∂logits = −p (log p + H)."""

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        log_p = params - params.max(-1, keepdims=True)
        log_p -= np.log(np.exp(log_p).sum(-1, keepdims=True))
        self._log_p, self._p = log_p, np.exp(log_p)
        self._rows, self._action = np.arange(len(params)), action[:, 0]
        self._entropy = -(self._p * log_p).sum(-1)
        return log_p[self._rows, self._action], self._entropy

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        g: Array = self._log_p + self._entropy[:, None]
        g *= -by_entropy[:, None]
        g -= by_log_prob[:, None]
        g *= self._p
        g[self._rows, self._action] += by_log_prob
        return g


class _Several(_Action):
    """A product of categoricals."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self._ends = np.cumsum(sizes)[:-1]
        self._parts = [_Categorical() for _ in sizes]

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        choices = np.split(action, action.shape[1], -1)
        logits = np.split(params, self._ends, -1)
        found = [part.forward(*each) for part, *each in zip(self._parts, logits, choices, strict=True)]
        log_probs, entropies = zip(*found, strict=True)
        return np.sum(log_probs, 0), np.sum(entropies, 0)

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        return np.concatenate([part.backward(by_log_prob, by_entropy) for part in self._parts], -1)


class _Bits(_Action):
    """Independent bits with logits l: ∂log π/∂l = bit − σ(l);  ∂H/∂l = −l σ(l) (1 − σ(l))."""

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        self._logits, self._bits = params, action.astype(params.dtype)
        self._on = 0.5 + 0.5 * np.tanh(0.5 * params)
        softplus = np.logaddexp(0, params)
        return (self._bits * params - softplus).sum(-1), (softplus - params * self._on).sum(-1)

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        spread = self._logits * self._on * (1 - self._on)
        found: Array = by_log_prob[:, None] * (self._bits - self._on) - by_entropy[:, None] * spread
        return found


class _Gaussian(_Action):
    """z = (a − μ) / σ: ∂log π/∂μ = z / σ;  ∂log π/∂log σ = z² − 1;  ∂H/∂log σ = 1. log σ does not depend on the state."""

    def __init__(self, log_std: Array, log_std_grad: Array) -> None:
        self._log_std, self._log_std_grad = log_std, log_std_grad

    def forward(self, params: Array, action: Array) -> tuple[Array, Array]:
        self._inverse = np.exp(-self._log_std)
        self._z = (action - params) * self._inverse
        self._squared = self._z * self._z
        constant = self._log_std.sum() + len(self._log_std) * LOG_SQRT_2PI
        entropy = np.full(len(params), self._log_std.sum() + len(self._log_std) * (0.5 + LOG_SQRT_2PI), params.dtype)
        log_prob: Array = -0.5 * self._squared.sum(-1) - constant
        return log_prob, entropy

    def backward(self, by_log_prob: Array, by_entropy: Array) -> Array:
        np.matmul(by_log_prob, self._squared - 1, out=self._log_std_grad)
        self._log_std_grad += by_entropy.sum()
        self._z *= self._inverse
        self._z *= by_log_prob[:, None]
        found: Array = self._z
        return found


def _action(spec: ActionSpec, log_std: Array | None, log_std_grad: Array | None) -> _Action:
    match spec.kind:
        case "discrete":
            return _Categorical()
        case "multidiscrete":
            return _Several(spec.sizes)
        case "multibinary":
            return _Bits()
        case "box":
            assert log_std is not None
            assert log_std_grad is not None
            return _Gaussian(log_std, log_std_grad)
    raise ValueError(spec.kind)
