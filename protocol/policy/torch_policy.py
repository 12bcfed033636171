"""The forward pass in torch, with which workers act if the policy has images or a user-defined encoder.

Rule: a pass does not depend on the torch defaults that the program, or an environment, has set for its own purposes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from millrace.protocol.arrays import Array, Floats
from millrace.protocol.policy.acting_network import ActingNetwork
from millrace.protocol.policy.features import features
from millrace.protocol.policy.layout import appended_params, buffer_layout, buffer_size, named_views, parameter_layout
from millrace.protocol.policy.normalize import normalize
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.policy.torch_defaults import defaults_of_thread
from millrace.protocol.specs import PolicySpec
from millrace.protocol.wire.weight_dtypes import ActingDtype


class TorchPolicy:
    """Like `NumpyPolicy`, for policies with images or encoders. Lanes are computed one by one, so that a lane's result does
    not depend on other lanes.
    """

    def __init__(
        self, spec: PolicySpec, device: str = "cpu", *, together: bool = False, images: ActingDtype = "float32"
    ) -> None:
        """With `together`, all lanes are computed at once. Use it if every call passes the same lanes.

        `images` is the precision in which images are processed.
        """
        self.spec = spec
        self._images_dtype = images
        self._device = device
        self._together = together
        with defaults_of_thread():
            self._net = ActingNetwork(spec, device)
        self._buffers: dict[str, Floats] = {}

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Copy these weights, and use them from now on. Raises `ValueError` if their sizes do not fit the spec."""
        count = len(self._net.flat)
        if parameters.shape != (count,) or buffers.shape != (buffer_size(self.spec),):
            raise ValueError(
                f"weights: expected {count} parameters and {buffer_size(self.spec)} buffers, "
                f"got {parameters.shape} and {buffers.shape}"
            )
        with defaults_of_thread():
            self._net.flat.copy_(torch.tensor(parameters))
            if self._images_dtype == "bfloat16":
                self._net.encode.use_bfloat16()
        self._buffers = named_views(buffers, buffer_layout(self.spec))
        named = named_views(parameters, parameter_layout(self.spec)[0])
        self._appended_params = appended_params(self.spec, named, self._buffers)

    def __call__(self, leaves: Sequence[Array], state: Floats | None = None) -> Floats:
        """Distribution params [L, N, P] for these observations [L, N, *leaf]; see `Policy`."""
        x = features(self.spec, leaves)
        if self.spec.normalize_observations:
            x = normalize(x, self._buffers["observation_mean"], self._buffers["observation_std"])
        images = [array for leaf, array in zip(self.spec.observation, leaves, strict=True) if leaf.is_image]
        state = zero_state(self.spec, *x.shape[:-1]) if state is None else state
        if self._together:
            L, N = x.shape[:2]
            flat_state = state.reshape(L * N, -1)
            flat = self._lane(x.reshape(L * N, -1), [image.reshape(L * N, *image.shape[2:]) for image in images], flat_state)
            out = flat.reshape(L, N, -1)
            state[...] = flat_state.reshape(state.shape)
        else:
            out = np.stack([self._lane(x[lane], [image[lane] for image in images], state[lane]) for lane in range(len(x))])
        appended = self._appended_params
        if appended is None:
            return out
        return np.concatenate([out, np.broadcast_to(appended, (*out.shape[:-1], len(appended)))], -1)

    def _lane(self, x: Floats, images: Sequence[Array], state: Floats) -> Floats:
        """The network's outputs [N, O] for one lane, given x [N, D], images [N, *leaf] and state [N, S], which is updated in
        place.
        """
        inputs = torch.tensor(x, device=self._device), [torch.tensor(image, device=self._device) for image in images]
        with defaults_of_thread(), torch.no_grad():
            out, after = self._net(*inputs, torch.tensor(state, device=self._device))
        state[:] = after.cpu().numpy()
        return np.asarray(out.cpu().numpy())
