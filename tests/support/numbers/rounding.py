"""How far two float32 computations of any function in torch may differ, on any processor: found by sampling in float64.

The tolerances are derived, not tuned. Each rounding of a sum changes it by at most u s, where u = 2^-24 in float32 and s is
the sum of the absolute values of its terms. Roundings are taken as independent with mean 0. So n of them change the sum by
at most λ √n u s, except with a probability of 2 exp(-λ²/2) (Higham and Mary 2019, "A new approach to probabilistic rounding
error analysis", theorem 2.4; terms in u² are left out). Here λ is 4. The order of the sum, and so the processor and its
kernels, makes no difference.

The function is computed in float64, once as it is and `SAMPLES` times with noise added to the result of each operation. The
noise is uniform, and its standard deviation is the bound above: √n u s for a sum of n terms, and ELEMENTWISE u s for an
operation on single elements. So the errors go through the function itself, its gradient included, and no derivative is
written down here ("Monte Carlo arithmetic", Parker 1997). The mean of the squared deviations is the variance of each result,
and `tolerance_of` gives the tolerance.

The bound of a sum is several times its true deviation, because its partial sums are smaller than s. This outweighs by far
that a variance found with this number of samples may be too small.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from millrace.learner.algorithms.bodies.networks import ActorAndCritics, ActorCriticNetwork, FlatNetwork, QNetwork
from millrace.protocol.arrays import Array
from millrace.protocol.policy.encoder import RecurrentInput

UNIT = 2.0**-24
ELEMENTWISE = 16  # roundings that an activation, a softmax or a log-probability adds
SAMPLES = 16

EXACT = (
    *("_to_copy", "_unsafe_view", "abs", "amax", "cat", "clamp", "clone", "eq", "gather", "ge", "gt", "index", "le", "lt"),
    "index_put",  # of rows that were each selected once
    *("logical_and", "masked_fill", "minimum", "maximum", "neg", "new_ones", "new_zeros", "ones_like", "randn", "relu"),
    *("scalar_tensor", "scatter_add", "select_backward", "slice_backward", "stack", "threshold_backward", "unsafe_split"),
    "where",
)
# How large the terms are whose roundings make up the error of one element, by the arguments and the result.
ELEMENTWISE_SIZES: dict[str, Callable[[Sequence[Any], Tensor], Tensor]] = (
    {
        "add": lambda args, out: _magnitude(args[0]) + _magnitude(args[1]),
        "sub": lambda args, out: _magnitude(args[0]) + _magnitude(args[1]),
        "sigmoid": lambda args, out: torch.ones_like(out),  # by tanh, its errors are relative to 1
        "sin": lambda args, out: torch.ones_like(out),
        "cos": lambda args, out: torch.ones_like(out),
        "silu": lambda args, out: _magnitude(args[0]),
        "smooth_l1_loss": lambda args, out: _magnitude(args[0]) + _magnitude(args[1]),
        "smooth_l1_loss_backward": lambda args, out: args[0].abs() * (args[1].abs() + args[2].abs()),
        "softplus": lambda args, out: _magnitude(args[0]) + out,
        "_log_softmax": lambda args, out: args[0].abs().amax(-1, keepdim=True) + out.abs(),
        "_log_softmax_backward_data": lambda args, out: args[0].abs() + args[1].exp() * args[0].abs().sum(-1, keepdim=True),
    }
    | {
        name: lambda args, out: _magnitude(args[0])  # g times a slope: 1 - y², y (1 - y), a sigmoid
        for name in ("tanh_backward", "sigmoid_backward", "softplus_backward")
    }
    | {name: lambda args, out: out.abs() for name in ("tanh", "mul", "div", "pow", "exp", "expm1")}
)
# The number of terms of a sum, by the arguments. On absolute values the operation gives the sum of their absolute values.
TERMS: dict[str, Callable[[Sequence[Any], Tensor], int]] = {
    "mm": lambda args, out: args[0].shape[1],
    "addmm": lambda args, out: args[1].shape[1] + 1,
    "sum": lambda args, out: args[0].numel() // out.numel(),
    "mean": lambda args, out: args[0].numel() // out.numel(),
    "convolution": lambda args, out: args[1][0].numel() + 1,
    "convolution_backward": lambda args, out: max(args[2].shape[0], len(args[0])) * args[0][0, 0].numel(),
}


class Sampled(NamedTuple):
    """Results in float64, and how far two float32 computations of them may differ."""

    exact: Array
    tolerance: Array

    def assert_is(self, *found: Array) -> None:
        """Assert that these float32 results are those of the function, and of each other, except for rounding."""
        for each in found:
            assert_within(each, self.exact, self.tolerance)
            assert_within(each, found[0], self.tolerance)


def sampled(function: Callable[[], Sequence[Tensor]]) -> list[Sampled]:
    """The float64 results of `function` and their tolerances."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # arrays are small
    try:
        exact = [each.detach().numpy().copy() for each in function()]
        squares = [np.zeros(each.shape) for each in exact]
        with _Noise(np.random.default_rng(0)):
            for _ in range(SAMPLES):
                for total, each, noisy in zip(squares, exact, function(), strict=True):
                    total += (noisy.detach().numpy() - each) ** 2
    finally:
        torch.set_num_threads(threads)
    return [Sampled(each, tolerance_of(total / SAMPLES)) for each, total in zip(exact, squares, strict=True)]


def tolerance_of(variance: Array) -> Array:
    """How far two float32 results may differ, each of which has errors of this variance: 4 standard deviations."""
    return np.asarray(4 * np.sqrt(2 * variance))


def assert_within(found: Array, expected: Array, tolerance: Array) -> None:
    """Assert that |found − expected| is at most `tolerance`, element by element."""
    off = np.abs(np.asarray(found, np.float64) - np.asarray(expected, np.float64))
    assert off.shape == tolerance.shape
    assert (off <= tolerance).all(), f"{off.max():.3g} off, {tolerance.flat[int(np.argmax(off - tolerance))]:.3g} allowed"


def in_float64(net: FlatNetwork) -> Any:
    """A copy of a network in plain torch without its flat tensors: the parameters are float64, each by itself."""
    made = next(kind for kind in (ActorCriticNetwork, QNetwork, ActorAndCritics) if isinstance(net, kind))(net.spec)
    for name, parameter in made.parameters.items():
        parameter.grad = None
        parameter.data = net.parameters[name].detach().double()
    return made


def in_double(value: Any) -> Any:
    """A float tensor in float64, also in the input of a core; anything else as it is."""
    if isinstance(value, RecurrentInput):
        return RecurrentInput(*map(in_double, value))
    return value.double() if isinstance(value, Tensor) and value.is_floating_point() else value


def flat_gradient(loss: Tensor, net: FlatNetwork) -> Tensor:
    """The gradient [P] of a loss by all parameters of a network, one after another."""
    leaves = list(net.parameters.values())
    return torch.cat([each.flatten() for each in torch.autograd.grad(loss, leaves, materialize_grads=True)])


def _magnitude(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.abs() if value.is_floating_point() else value
    return abs(value) if isinstance(value, float) else value


class _Noise(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Adds noise to the result of each operation on float64 numbers, and refuses operations that it does not know."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # else torch imports its compiler, which takes seconds, to exclude this class from compilation

    def __init__(self, generator: np.random.Generator) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._generator = generator

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func.overloadpacket.__name__
        if func.is_view or name.removesuffix("_") in EXACT:
            return func(*args, **kwargs)
        kind, before = name.removesuffix("_"), args
        if name != kind:
            before = [each.clone() if isinstance(each, Tensor) else each for each in args]
        out = func(*args, **kwargs)
        if kind in ELEMENTWISE_SIZES:
            assert not kwargs, f"{func} with {list(kwargs)}: how large are its terms?"
            self._add(out, ELEMENTWISE * ELEMENTWISE_SIZES[kind](before, out))
        elif kind in TERMS:
            sizes = func(*map(_magnitude, before), **kwargs)
            several = isinstance(out, tuple)
            for result, size in zip(out if several else [out], sizes if several else [sizes], strict=True):
                if result is not None:
                    self._add(result, math.sqrt(TERMS[kind](before, result)) * size)
        elif kind == "std_mean":  # of n numbers
            n = args[0].numel()
            self._add(out[0], (math.sqrt(n) + ELEMENTWISE) * out[0])
            self._add(out[1], math.sqrt(n) * args[0].abs().mean())
        elif kind == "native_layer_norm":
            return self._layer_norm(func, *args)
        else:
            raise NotImplementedError(f"{func}: say here how large its rounding errors are")
        return out

    def _layer_norm(self, func: Any, x: Tensor, shape: Sequence[int], *others: Any) -> Any:
        """It is that of numbers with errors of the largest of a row, as the mean has, and is rounded; n roundings each."""
        n = math.prod(shape)
        moved = x.clone()
        self._add(moved, math.sqrt(n) * x.abs().amax(-1, keepdim=True).expand_as(x))
        found = func(moved, shape, *others)
        self._add(found[0], (n + ELEMENTWISE) * found[0].abs())
        return found

    def _add(self, result: Tensor, roundings: Tensor) -> None:
        """Add noise to `result`, with a standard deviation of `roundings` u."""
        if result.dtype == torch.float64:
            noise = np.asarray(self._generator.random(tuple(result.shape), np.float32) - np.float32(0.5))
            result.add_(roundings * torch.from_numpy(noise), alpha=math.sqrt(12) * UNIT)
