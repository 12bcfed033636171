"""How far two float32 computations of the same outputs or the same gradient may differ, on any processor.

The tolerances are derived, not tuned. A sum of products whose terms pass through n roundings differs from the exact sum by
at most g(n) times the sum of the absolute values of its terms, with

    g(n) = exp(4 √n u + n u² / (1 - u)) - 1,    u = 2^-24 in float32

except with a probability of 2 exp(-8) for each n (Higham and Mary 2019, "A new approach to probabilistic rounding error
analysis", theorem 2.4 with λ = 4). The order of the sum, and so the processor and its kernels, makes no difference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from protocol.arrays import Array
from protocol.policy.layout import hidden_names, named_views, parameter_layout, total_size
from protocol.policy.torch_distributions import log_prob_and_entropy
from protocol.specs import PolicySpec

UNIT = 2.0**-24
ELEMENTWISE = 16  # roundings that an activation, a softmax or a log-probability adds


def growth(roundings: int) -> float:
    """g(n) for float32."""
    return math.expm1(4 * math.sqrt(roundings) * UNIT + roundings * UNIT**2 / (1 - UNIT))


def forward_tolerance(layers: Sequence[tuple[Array, Array]], x: Array, relu: bool = False) -> Array:
    """How far two float32 forward passes of the same MLP may differ, [B, outputs].

    `layers`: weight [out, in] and bias [out] of each layer, the last one linear; `x` [B, in]. A unit is a sum of n = in + 1
    terms. Each of its n roundings is at most u s with s = |h| |W|ᵀ + |b|, and roundings are independent (as in `growth`). So
    a layer adds a variance of at most n (u s)², and its weights carry over the variance v of its input: v W²ᵀ. tanh and ReLU
    do not enlarge an error, and add ELEMENTWISE roundings. The difference of two passes has twice the variance. The result
    is 4 standard deviations (λ in `growth`) of this bound, which is itself several times the true deviation.

    A test in `test_fused` shows that the loss of a single term exceeds it.
    """
    h, variance = x.astype(np.float64), np.zeros(x.shape)
    for i, (weight, bias) in enumerate(layers):
        w, b = weight.astype(np.float64), bias.astype(np.float64)
        size = np.abs(h) @ np.abs(w).T + np.abs(b)
        variance = variance @ (w**2).T + (w.shape[1] + 1) * (UNIT * size) ** 2
        h = h @ w.T + b
        if i < len(layers) - 1:
            h = np.maximum(h, 0) if relu else np.tanh(h)
            variance = variance + (ELEMENTWISE * UNIT * h) ** 2
    return np.asarray(4 * np.sqrt(2 * variance))


def network_layers(parameters: Mapping[str, torch.Tensor], names: Sequence[str]) -> list[tuple[Array, Array]]:
    """Weight and bias of each of these layers, as `forward_tolerance` takes them."""
    return [
        (parameters[f"{name}.weight"].detach().numpy().copy(), parameters[f"{name}.bias"].detach().numpy().copy())
        for name in names
    ]


def assert_within(found: Array, expected: Array, tolerance: Array) -> None:
    """Assert that |found − expected| is at most `tolerance`, element by element."""
    off = np.abs(np.asarray(found, np.float64) - np.asarray(expected, np.float64))
    assert off.shape == tolerance.shape
    assert (off <= tolerance).all(), f"{off.max():.3g} off, {tolerance.flat[int(np.argmax(off - tolerance))]:.3g} allowed"


def sums_of_absolute_values(
    spec: PolicySpec, flat: Array, x: Array, action: Array, by_outputs: tuple[Array, Array, Array]
) -> tuple[Array, int]:
    """What the gradient of each parameter [P] of a tanh actor-critic is a sum of, and how many roundings a term passes.

    `flat` [P], `x` [B, D] and `by_outputs` (gradients by log-probability, entropy and value, [B] each) are float64. A
    backward pass over absolute values gives the sums. The policy has no shared trunk.
    """
    fields = sum(parameter_layout(spec), ())
    weights, found = named_views(flat, fields), np.zeros(total_size(fields))
    grads = named_views(found, fields)
    by_log_prob, by_entropy, by_value = map(np.abs, by_outputs)

    def trunk(names: list[str]) -> list[Array]:
        """The input of each layer, and the output of the last."""
        inputs = [x]
        for name in names:
            inputs.append(np.tanh(inputs[-1] @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]))
        return inputs

    def back(names: list[str], inputs: list[Array], by_out: Array) -> None:
        """Sums of absolute values: `by_out` [B, outputs] of the last of these layers, which is linear."""
        for i, name in reversed(list(enumerate(names))):
            grads[f"{name}.weight"][:] = by_out.T @ np.abs(inputs[i])
            grads[f"{name}.bias"][:] = by_out.sum(0)
            by_out = by_out @ np.abs(weights[f"{name}.weight"]) * (1 - inputs[i] ** 2)

    acting, judging = hidden_names(spec), hidden_names(spec, "critic")
    inputs = trunk(acting)
    out = inputs[-1] @ weights["actor.out.weight"].T + weights["actor.out.bias"]
    log_std = weights.get("actor.log_std")
    params = out if log_std is None else np.concatenate([out, np.broadcast_to(log_std, out.shape)], -1)
    leaf = torch.tensor(params, requires_grad=True)
    log_prob, entropy = log_prob_and_entropy(spec.action, leaf, torch.tensor(action))
    slopes = [torch.autograd.grad(each.sum(), leaf, retain_graph=True, allow_unused=True)[0] for each in (log_prob, entropy)]
    of_log_prob, of_entropy = (np.zeros_like(params) if slope is None else slope.abs().numpy() for slope in slopes)
    by_params = by_log_prob[:, None] * of_log_prob + by_entropy[:, None] * of_entropy
    if log_std is not None:
        grads["actor.log_std"][:] = by_params[:, out.shape[1] :].sum(0)
    back([*acting, "actor.out"], inputs, by_params[:, : out.shape[1]])
    back([*judging, "critic.out"], trunk(judging), by_value[:, None])
    roundings = len(x) + 2 * (x.shape[1] + sum(spec.net)) + ELEMENTWISE * (2 + len(spec.net))
    return found, roundings
