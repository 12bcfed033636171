"""How far two float32 computations of the same gradient may differ, on any processor.

The tolerance is derived, not tuned. A sum of products whose terms pass through n roundings differs from the exact sum by at
most g(n) times the sum of the absolute values of its terms, with

    g(n) = exp(4 √n u + n u² / (1 - u)) - 1,    u = 2^-24 in float32

except with a probability of 2 exp(-8) for each n (Higham and Mary 2019, "A new approach to probabilistic rounding error
analysis", theorem 2.4 with λ = 4). The order of the sum, and so the processor and its kernels, makes no difference.
"""

from __future__ import annotations

import math

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
