"""The network in torch with which a policy acts: the encoder, the hidden layers and the head, as in `numpy_policy.py`.

Rule: it has only the parameters that are needed to act. Critics, gradients and initial weights belong to the networks that
the learner trains (`learner/algorithms/bodies/networks.py`). With the same parameters, these give the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from millrace.protocol.policy.encoder import Encoder
from millrace.protocol.policy.heads import HEADS
from millrace.protocol.policy.layout import LOG_STD_BOUNDS, hidden_names, named_views, parameter_layout, total_size
from millrace.protocol.policy.malloc import keep_freed_memory
from millrace.protocol.specs import PolicySpec


class ActingNetwork:
    """Computes a policy's outputs. Call it under `torch.no_grad`."""

    def __init__(self, spec: PolicySpec, device: str | torch.device = "cpu") -> None:
        fields, _ = parameter_layout(spec)
        head = HEADS[spec.head]
        self.flat = torch.empty(total_size(fields), dtype=torch.float32, device=device)
        """[P] the parameters. They have no values until you copy some to this tensor"""
        self._parameters = named_views(self.flat, fields)
        self.encode = Encoder(spec, self._parameters, device, seed=0)
        self._hidden = [self._linear(name) for name in hidden_names(spec)]
        self._out = self._linear(f"{head.prefix}.out")
        self._state_value = self._linear("q.value") if spec.dueling else None
        self._relu = spec.activation == "relu"
        self._has_log_std_outputs = head.has_log_std_outputs
        if spec.needs_torch:
            keep_freed_memory()

    def _linear(self, name: str) -> tuple[Tensor, Tensor]:
        return self._parameters[f"{name}.weight"].t(), self._parameters[f"{name}.bias"]

    def __call__(self, x: Tensor, images: Sequence[Tensor], state: Tensor) -> tuple[Tensor, Tensor]:
        """The outputs [B, O] for one step of B copies, and the core's state [B, S] after it.

        x [B, D] are the normalized features, and images [B, *leaf] are uint8.
        """
        h, state = self.encode.act(x, images, state)
        for weight, bias in self._hidden:
            h = torch.addmm(bias, h, weight)
            h = h.relu_() if self._relu else h.tanh_()
        weight, bias = self._out
        out = torch.addmm(bias, h, weight)
        if self._has_log_std_outputs:
            mean, log_std = out.chunk(2, -1)
            out = torch.cat((mean, log_std.clamp(*LOG_STD_BOUNDS)), -1)
        if self._state_value is not None:
            weight, bias = self._state_value
            out = torch.addmm(bias, h, weight) + out - out.mean(-1, keepdim=True)
        return out, state
