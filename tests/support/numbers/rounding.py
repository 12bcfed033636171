"""How far two float32 computations of the same outputs or the same gradient may differ, on any processor.

The tolerances are derived, not tuned. Each rounding of a sum changes it by at most u s, where u = 2^-24 in float32 and s is
the sum of the absolute values of its terms. Roundings are taken as independent with mean 0. So n of them change the sum by
at most λ √n u s, except with a probability of 2 exp(-λ²/2) (Higham and Mary 2019, "A new approach to probabilistic rounding
error analysis", theorem 2.4; terms in u² are left out). Here λ is 4. The order of the sum, and so the processor and its
kernels, makes no difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from protocol.arrays import Array
from protocol.policy.layout import hidden_names, named_views, parameter_layout, total_size
from protocol.policy.networks import ActorCriticNetwork
from protocol.policy.torch_distributions import log_prob_and_entropy
from protocol.specs import PolicySpec

UNIT = 2.0**-24
ELEMENTWISE = 16  # roundings that an activation, a softmax or a log-probability adds


class Forward(NamedTuple):
    """A float64 forward pass of an MLP, and the variance of the rounding errors of a float32 one."""

    inputs: list[Array]  # [B, in] of each layer
    variances: list[Array]
    undecided: list[Array]  # True where rounding decides on which side of 0 the argument of a ReLU lies
    out: Array  # [B, outputs]
    out_variance: Array


def forward_pass(layers: Sequence[tuple[Array, Array]], x: Array, relu: bool = False) -> Forward:
    """See `forward_tolerance`, which explains the variance."""
    h, variance = x.astype(np.float64), np.zeros(x.shape)
    inputs, variances, undecided = [h], [variance], [np.zeros(x.shape, bool)]
    for i, (weight, bias) in enumerate(layers):
        w, b = weight.astype(np.float64), bias.astype(np.float64)
        size = np.abs(h) @ np.abs(w).T + np.abs(b)
        variance = variance @ (w**2).T + (w.shape[1] + 1) * (UNIT * size) ** 2
        h = h @ w.T + b
        if i < len(layers) - 1:
            undecided.append(np.abs(h) <= tolerance_of(variance))
            h = np.maximum(h, 0) if relu else np.tanh(h)
            variance = variance + (ELEMENTWISE * UNIT * h) ** 2
            inputs.append(h)
            variances.append(variance)
    return Forward(inputs, variances, undecided, h, variance)


def tolerance_of(variance: Array) -> Array:
    """How far two float32 results may differ, each of which has errors of this variance: 4 standard deviations."""
    return np.asarray(4 * np.sqrt(2 * variance))


def forward_tolerance(layers: Sequence[tuple[Array, Array]], x: Array, relu: bool = False) -> Array:
    """How far two float32 forward passes of the same MLP may differ, [B, outputs].

    `layers`: weight [out, in] and bias [out] of each layer, the last one linear; `x` [B, in]. A unit is a sum of n = in + 1
    terms. Each of its n roundings is at most u s with s = |h| |W|ᵀ + |b|, and roundings are independent. So a layer adds a
    variance of at most n (u s)², and its weights carry over the variance v of its input: v W²ᵀ. tanh and ReLU do not enlarge
    an error, and add ELEMENTWISE roundings. The difference of two passes has twice the variance. The result is 4 standard
    deviations (λ above) of this bound, which is itself several times the true deviation.

    A test in `test_fused` shows that the loss of a single term exceeds it.
    """
    return tolerance_of(forward_pass(layers, x, relu).out_variance)


def gradient_variances(
    layers: Sequence[tuple[Array, Array]], x: Array, by_output: Array, by_output_variance: Array, relu: bool = False
) -> list[tuple[Array, Array]]:
    """The variance of the rounding errors of the gradient of an MLP, by weight and bias of each layer.

    `by_output` [B, outputs] is the gradient by the outputs, with errors of `by_output_variance`. The rules are those of
    `forward_tolerance`: a sum of n terms adds n (u s)², where s is the sum of their absolute values, and the factors of a
    product hand their variances on. The slope of tanh is 1 - h², and so has 4 h² times the variance of h. The slope of ReLU
    is exact, except where rounding decides on which side of 0 its argument lies; there it may be off by 1.
    """
    forward = forward_pass(layers, x, relu)
    by_out, variance, rows = by_output, by_output_variance, len(x)
    found: list[tuple[Array, Array]] = []
    for i in reversed(range(len(layers))):
        h, size = forward.inputs[i], np.abs(by_out)
        weight = variance.T @ h**2 + (by_out**2).T @ forward.variances[i] + (rows + 1) * (UNIT * size.T @ np.abs(h)) ** 2
        found.append((weight, variance.sum(0) + rows * (UNIT * size.sum(0)) ** 2))
        w = layers[i][0].astype(np.float64)
        by_h, variance = by_out @ w, variance @ w**2 + (w.shape[0] + 1) * (UNIT * size @ np.abs(w)) ** 2
        if relu:
            slope, slope_variance = (h > 0) * 1.0, forward.undecided[i] * 1.0
        else:
            slope, slope_variance = 1 - h**2, 4 * h**2 * forward.variances[i] + (ELEMENTWISE * UNIT) ** 2
        variance = variance * (slope**2 + slope_variance) + by_h**2 * slope_variance
        by_out = by_h * slope
    return found[::-1]


def core_tolerance(core: str, parameters: Mapping[str, Array], x: Array, state: Array) -> tuple[Array, Array]:
    """How far two float32 computations of a recurrent core may differ: outputs [T, C, H] and last state [C, S].

    `parameters` are those of the two linear maps into the gates, `x` [T, C, D], `state` [C, S]. The rules are those of
    `forward_tolerance`. A sigmoid or tanh hands a variance on by the square of its slope; a product a b has the variance
    a² var b + b² var a; and a sum of two products adds ELEMENTWISE roundings of the sum of their absolute values.
    """
    (w, b), (u, d) = (
        [np.asarray(parameters[f"core.{name}.{kind}"], np.float64) for kind in ("weight", "bias")]
        for name in ("input", "state")
    )
    H, step = u.shape[1], ELEMENTWISE * UNIT
    h, c = state[:, :H].astype(np.float64), state[:, H:].astype(np.float64)
    h_variance, c_variance = np.zeros(h.shape), np.zeros(c.shape)
    outputs: list[Array] = []

    def sigmoid(z: Array, variance: Array) -> tuple[Array, Array]:
        gate = 1 / (1 + np.exp(-z))
        return gate, (gate * (1 - gate)) ** 2 * variance + step**2  # by tanh: its errors are relative to 1

    def tanh(z: Array, variance: Array) -> tuple[Array, Array]:
        found = np.tanh(z)
        return found, (1 - found**2) ** 2 * variance + (step * found) ** 2

    for row in x.astype(np.float64):
        n = w.shape[1] + H + 2
        from_input, from_state = row @ w.T + b, h @ u.T + d
        input_variance = n * (UNIT * (np.abs(row) @ np.abs(w).T + np.abs(b))) ** 2
        state_variance = h_variance @ (u**2).T + n * (UNIT * (np.abs(h) @ np.abs(u).T + np.abs(d))) ** 2
        if core == "lstm":
            z, variance = from_input + from_state, input_variance + state_variance
            (i, vi), (f, vf), (g, vg), (o, vo) = (
                activation(z[:, k * H : (k + 1) * H], variance[:, k * H : (k + 1) * H])
                for k, activation in enumerate((sigmoid, sigmoid, tanh, sigmoid))
            )
            rounded = (step * (np.abs(f * c) + np.abs(i * g))) ** 2
            c_variance = f**2 * c_variance + c**2 * vf + i**2 * vg + g**2 * vi + rounded
            c = f * c + i * g
            squashed, vs = tanh(c, c_variance)
            h, h_variance = o * squashed, o**2 * vs + squashed**2 * vo
        else:
            gates, variances = sigmoid((from_input + from_state)[:, : 2 * H], (input_variance + state_variance)[:, : 2 * H])
            (r, k), (vr, vk) = np.split(gates, 2, -1), np.split(variances, 2, -1)
            a, p = from_input[:, 2 * H :], from_state[:, 2 * H :]
            rounded = (step * (np.abs(a) + np.abs(r * p))) ** 2
            v = input_variance[:, 2 * H :] + r**2 * state_variance[:, 2 * H :] + p**2 * vr + rounded
            new, vn = tanh(a + r * p, v)
            rounded = (step * (np.abs(h) + np.abs(new))) ** 2
            h_variance = (1 - k) ** 2 * vn + k**2 * h_variance + (h - new) ** 2 * vk + rounded
            h = new + k * (h - new)
        outputs.append(h_variance)
    return tolerance_of(np.stack(outputs)), tolerance_of(np.concatenate([h_variance, c_variance], -1))


def variance_after(function: Callable[[Array], Array], params: Array, variance: Array) -> Array:
    """The variance of the rounding errors of `function` [B, ...] of distribution parameters [B, P] with this variance.

    A float32 log-probability, or its gradient, is that of slightly other parameters (ELEMENTWISE roundings of the largest of
    the row), rounded ELEMENTWISE times itself. Each parameter is moved by one standard deviation, and what that changes in
    the result, in float64, is squared and added up.
    """
    exact = function(params)
    own = ELEMENTWISE * UNIT * np.maximum(1, np.abs(params).max(1))
    total = (ELEMENTWISE * UNIT * exact) ** 2
    for j in range(params.shape[1]):
        moved = params.copy()
        moved[:, j] += np.sqrt(variance[:, j] + own**2)
        total = total + (function(moved) - exact) ** 2
    return np.asarray(total)


def params_variance(spec: PolicySpec, flat: Array, x: Array) -> tuple[Array, Array]:
    """The distribution parameters [B, P] of an MLP policy in float64, and the variance of their rounding errors in float32.

    `flat` holds the parameters of the policy, those needed to act first; `x` [B, D] are the features.
    """
    weights = named_views(flat.astype(np.float64), parameter_layout(spec)[0])
    layers = [(weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in (*hidden_names(spec), "actor.out")]
    forward = forward_pass(layers, x, spec.activation == "relu")
    if "actor.log_std" not in weights:
        return forward.out, forward.out_variance
    log_std = np.broadcast_to(weights["actor.log_std"], forward.out.shape)
    zeros = np.zeros_like(forward.out)
    return np.concatenate([forward.out, log_std], -1), np.concatenate([forward.out_variance, zeros], -1)


def log_prob_variance(spec: PolicySpec, flat: Array, x: Array, action: Array) -> Array:
    """The variance of the rounding errors of float32 log-probabilities [B] of an MLP policy; see `params_variance`."""
    return _log_prob_variance(spec, *params_variance(spec, flat, x), action)


def log_prob_tolerance(spec: PolicySpec, params: Array, action: Array) -> Array:
    """How far two float32 log-probabilities [B] of the same parameters [B, P] may differ."""
    return tolerance_of(_log_prob_variance(spec, params.astype(np.float64), np.zeros(params.shape), action))


def _log_prob_variance(spec: PolicySpec, params: Array, variance: Array, action: Array) -> Array:
    def log_prob(p: Array) -> Array:
        return log_prob_and_entropy(spec.action, torch.tensor(p), torch.tensor(action))[0].numpy()

    return variance_after(log_prob, params, variance)


class ActorCriticTolerance(NamedTuple):
    """How far two float32 computations may differ."""

    log_prob: Array  # [B]
    entropy: Array  # [B]
    gradient: Array  # [P]


def actor_critic_tolerance(
    spec: PolicySpec,
    flat: Array,
    x: Array,
    action: Array,
    by_outputs: Sequence[Array],
    by_log_prob_variance: Array | float = 0.0,
    by_value_variance: Array | float = 0.0,
) -> ActorCriticTolerance:
    """Of the log-probabilities and entropies of an MLP actor-critic, and of its gradient.

    `flat` [P] are the parameters, `x` [B, D] the features; `by_outputs` are the gradients by log-probability, entropy and
    value, [B] each; two of them may have errors, of these variances. See `gradient_variances` and `variance_after`. If actor
    and critic share a trunk, the errors of their two gradients depend on one another, and the variance of the sum is at most
    twice the sum of the variances.
    """
    fields, relu, rows = sum(parameter_layout(spec), ()), spec.activation == "relu", len(x)
    weights, variances = named_views(flat.astype(np.float64), fields), np.zeros(total_size(fields))
    of_field = named_views(variances, fields)
    by_log_prob, by_entropy, by_value = (each.astype(np.float64) for each in by_outputs)

    def add(names: list[str], by_output: Array, by_output_variance: Array) -> None:
        layers = [(weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names]
        for name, (weight, bias) in zip(
            names, gradient_variances(layers, x, by_output, by_output_variance, relu), strict=True
        ):
            of_field[f"{name}.weight"] += weight
            of_field[f"{name}.bias"] += bias

    params, variance = params_variance(spec, flat, x)
    outputs = len(weights["actor.out.bias"])

    def entropy(p: Array) -> Array:
        return log_prob_and_entropy(spec.action, torch.tensor(p), torch.tensor(action))[1].numpy()

    def gradient(p: Array, by: Sequence[Array] = (by_log_prob, by_entropy)) -> Array:
        leaf = torch.tensor(p, requires_grad=True)
        outcome = log_prob_and_entropy(spec.action, leaf, torch.tensor(action))
        return torch.autograd.grad(outcome, leaf, [torch.tensor(each) for each in by])[0].numpy()

    by_params, by_params_variance = gradient(params), variance_after(gradient, params, variance)
    by_params_variance += gradient(params, (np.ones(rows), np.zeros(rows))) ** 2 * np.reshape(by_log_prob_variance, (-1, 1))
    add([*hidden_names(spec), "actor.out"], by_params[:, :outputs], by_params_variance[:, :outputs])
    if "actor.log_std" in weights:
        by_log_std = np.abs(by_params[:, outputs:]).sum(0)
        of_field["actor.log_std"] += by_params_variance[:, outputs:].sum(0) + rows * (UNIT * by_log_std) ** 2
    critic = [*hidden_names(spec, "" if spec.shared_net else "critic"), "critic.out"]
    add(critic, by_value[:, None], np.zeros((rows, 1)) + np.reshape(by_value_variance, (-1, 1)))
    return ActorCriticTolerance(
        tolerance_of(_log_prob_variance(spec, params, variance, action)),
        tolerance_of(variance_after(entropy, params, variance)),
        tolerance_of((1 + spec.shared_net) * variances),
    )


def network_layers(parameters: Mapping[str, torch.Tensor], names: Sequence[str]) -> list[tuple[Array, Array]]:
    """Weight and bias of each of these layers, as `forward_tolerance` takes them."""
    return [
        (parameters[f"{name}.weight"].detach().numpy().copy(), parameters[f"{name}.bias"].detach().numpy().copy())
        for name in names
    ]


def q_gradient_tolerance(
    spec: PolicySpec, flat: Array, x: Array, by_value: Array, by_value_variance: Array | float = 0.0
) -> Array:
    """How far two float32 gradients [P] may differ; x [B, D], `by_value` [B, A] is the gradient by the action values, and
    `by_value_variance` [B, A] that of its errors.

    With dueling, Q = V + A − mean A: a sum over the actions adds A roundings. V and A share the trunk, so that their errors
    depend on one another, and the variance of their sum is at most twice the sum of their variances.
    """
    fields, actions = parameter_layout(spec)[0], by_value.shape[1]
    variances = np.zeros(total_size(fields))
    weights, of_field = named_views(flat.astype(np.float64), fields), named_views(variances, fields)
    by_top = {"q.out": by_value}
    variance = by_value_variance + (UNIT * by_value) ** 2  # it is rounded to float32
    if spec.dueling:
        by_top = {"q.out": by_value - by_value.mean(1, keepdims=True), "q.value": by_value.sum(1, keepdims=True)}
        variance = variance.sum(1, keepdims=True) + (actions + 1) * (UNIT * np.abs(by_value).sum(1, keepdims=True)) ** 2
    for top, by_output in by_top.items():
        names = [*hidden_names(spec), top]
        layers = [(weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names]
        found = gradient_variances(
            layers, x, by_output, np.broadcast_to(variance, by_output.shape), spec.activation == "relu"
        )
        for name, (weight, bias) in zip(names, found, strict=True):
            of_field[f"{name}.weight"] += weight
            of_field[f"{name}.bias"] += bias
    return tolerance_of(len(by_top) * variances)


def value_tolerance(net: ActorCriticNetwork, x: Array) -> Array:
    """How far two float32 computations of the values [B] of features [B, D] may differ."""
    names = [*hidden_names(net.spec, "" if net.spec.shared_net else "critic"), "critic.out"]
    return forward_tolerance(network_layers(net.parameters, names), x, net.spec.activation == "relu")[:, 0]


def by_value_variance(net: ActorCriticNetwork, x: Array, by_value: Array, slope: float) -> Array:
    """The variance of the errors of the gradient by value [B], where it is `slope` times the value less its target."""
    names = [*hidden_names(net.spec, "" if net.spec.shared_net else "critic"), "critic.out"]
    forward = forward_pass(network_layers(net.parameters, names), x, net.spec.activation == "relu")
    return np.asarray(slope**2 * forward.out_variance[:, 0] + (ELEMENTWISE * UNIT * by_value) ** 2)


def assert_within(found: Array, expected: Array, tolerance: Array) -> None:
    """Assert that |found − expected| is at most `tolerance`, element by element."""
    off = np.abs(np.asarray(found, np.float64) - np.asarray(expected, np.float64))
    assert off.shape == tolerance.shape
    assert (off <= tolerance).all(), f"{off.max():.3g} off, {tolerance.flat[int(np.argmax(off - tolerance))]:.3g} allowed"
