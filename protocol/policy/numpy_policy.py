"""The forward pass in numpy with which workers act if the policy is an MLP. Imports no torch.

A pass processes several lanes at once, [L, N, ·]. numpy's stacked matmul gives each lane the same bits that it would get
alone, so a run does not depend on the number of its workers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.protocol.arrays import Array, Floats
from millrace.protocol.policy.features import features
from millrace.protocol.policy.heads import HEADS
from millrace.protocol.policy.layout import (
    LOG_STD_BOUNDS,
    appended_params,
    buffer_layout,
    buffer_size,
    hidden_names,
    named_views,
    parameter_layout,
    total_size,
)
from millrace.protocol.policy.normalize import normalize
from millrace.protocol.policy.recurrent import advance, zero_state
from millrace.protocol.specs import PolicySpec


class NumpyPolicy:
    """The forward pass of an MLP policy: a recurrent core if it has one, tanh or ReLU layers, and a linear head."""

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec
        self._head = HEADS[spec.head]
        self._fields, _ = parameter_layout(spec)
        self._parameters: dict[str, Floats] = {}
        self._buffers: dict[str, Floats] = {}
        leaf, *more = spec.observation
        self._is_one_vector = not more and (leaf.kind, leaf.dtype, len(leaf.shape)) == ("box", "float32", 1)
        self._hidden_outputs: list[Floats] = []  # [L, N, width] for each hidden layer, overwritten in each pass

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Use these weights from now on, without copying them. Raises `ValueError` if their sizes do not fit the spec."""
        if parameters.shape != (total_size(self._fields),) or buffers.shape != (buffer_size(self.spec),):
            raise ValueError(
                f"weights: expected {total_size(self._fields)} parameters and {buffer_size(self.spec)} buffers, "
                f"got {parameters.shape} and {buffers.shape}"
            )
        self._parameters = named_views(parameters, self._fields)
        self._buffers = named_views(buffers, buffer_layout(self.spec))
        self._hidden = [self._linear(name) for name in hidden_names(self.spec)]
        self._out = self._linear(f"{self._head.prefix}.out")
        self._appended_params = appended_params(self.spec, self._parameters, self._buffers)

    def _linear(self, name: str) -> tuple[Floats, Floats]:
        return self._parameters[f"{name}.weight"].T, self._parameters[f"{name}.bias"]

    def __call__(self, leaves: Sequence[Array], state: Floats | None = None) -> Floats:
        """Distribution params [L, N, P] for these observations [L, N, *leaf]; see `Policy`."""
        x = leaves[0] if self._is_one_vector else features(self.spec, leaves)
        if self.spec.normalize_observations:
            x = normalize(x, self._buffers["observation_mean"], self._buffers["observation_std"])
        if self.spec.core is not None:
            x = advance(self.spec, self._parameters, x, zero_state(self.spec, *x.shape[:-1]) if state is None else state)
        if not self._hidden_outputs or self._hidden_outputs[0].shape[:-1] != x.shape[:-1]:
            self._hidden_outputs = [np.empty((*x.shape[:-1], width), np.float32) for width in self.spec.net]
        relu = self.spec.activation == "relu"
        for (weight, bias), out in zip(self._hidden, self._hidden_outputs, strict=True):
            np.matmul(x, weight, out=out)
            np.add(out, bias, out=out)
            if relu:
                np.maximum(out, 0, out=out)
            else:
                np.tanh(out, out=out)
            x = out
        weight, bias = self._out
        out = np.asarray(np.matmul(x, weight))
        out += bias
        if self._head.has_log_std_outputs:
            half = out.shape[-1] // 2
            np.clip(out[..., half:], *LOG_STD_BOUNDS, out=out[..., half:])
        if self.spec.dueling:
            weight, bias = self._linear("q.value")
            out += np.matmul(x, weight) + bias - out.mean(-1, keepdims=True)
        if self._appended_params is None:
            return out
        width = out.shape[-1]
        params = np.empty((*out.shape[:-1], width + len(self._appended_params)), np.float32)
        params[..., :width] = out
        params[..., width:] = self._appended_params
        return params
