"""Acting: the flat parameter layout, features, and the numpy forward pass of MLP policies. Pure; imports no torch.

All parameters of a policy live in one flat float32 buffer, the acting part first, so that publishing is one copy of a
prefix and loading is views on the received frame. `layout` is the one place that says where each array stands; the torch
modules of `protocol.networks` are views into the same layout.

Forward passes work on lanes side by side, [L, N, ·]: numpy's stacked matmul gives each lane the bits it would get alone,
which is what makes a run independent of the number of its workers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from protocol.distributions import distribution
from protocol.specs import Leaf, PolicySpec

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

CLIP = np.float32(10.0)  # normalised observations are clipped to ±10
IMAGE_FEATURES = 128  # width of the layer between the convolutions of one image and the rest


class Field(NamedTuple):
    """One array of the flat buffer."""

    name: str
    shape: tuple[int, ...]
    gain: float
    """of the orthogonal initialisation; 0 for biases and log standard deviations, which start at zero"""


class Conv(NamedTuple):
    """One convolution: channels out, kernel size, stride."""

    channels: int
    kernel: int
    stride: int


NATURE = (Conv(32, 8, 4), Conv(64, 4, 2), Conv(64, 3, 1))  # Mnih et al. 2015
SMALL = (Conv(16, 3, 1), Conv(32, 3, 2))


def convolutions(leaf: Leaf) -> tuple[tuple[Conv, ...], tuple[int, int, int], int]:
    """For an image: its convolutions, its shape as (channels, height, width), and the size of the flattened output.

    The last dimension holds the channels unless it is larger than the first. Images of 36 pixels and more get the network
    of Mnih et al. (2015), smaller ones two 3 x 3 convolutions.
    """
    first, _, last = leaf.shape
    chw = (last, *leaf.shape[:2]) if last <= first else leaf.shape
    stack = NATURE if min(chw[1:]) >= 36 else SMALL
    height, width = chw[1:]
    for conv in stack:
        height, width = ((side - conv.kernel) // conv.stride + 1 for side in (height, width))
    return stack, (chw[0], chw[1], chw[2]), stack[-1].channels * max(height, 0) * max(width, 0)


def feature_size(spec: PolicySpec) -> int:
    """How many features the arrays that are not images make."""
    return sum(_leaf_features(leaf) for leaf in spec.observation if not leaf.is_image)


def _leaf_features(leaf: Leaf) -> int:
    return sum(leaf.sizes) if leaf.sizes else math.prod(leaf.shape)


def layout(spec: PolicySpec) -> tuple[tuple[Field, ...], tuple[Field, ...]]:
    """The fields of the flat buffer: those needed to act, then the critic's. Linear weights are [out, in]."""
    acting: list[Field] = []
    width = feature_size(spec)
    for i, leaf in enumerate(spec.observation):
        if not leaf.is_image:
            continue
        stack, (channels, _, _), flattened = convolutions(leaf)
        for j, conv in enumerate(stack):
            weight = (conv.channels, channels, conv.kernel, conv.kernel)
            acting += [
                Field(f"image{i}.{j}.weight", weight, math.sqrt(2)),
                Field(f"image{i}.{j}.bias", (conv.channels,), 0),
            ]
            channels = conv.channels
        acting += _linear(f"image{i}.out", flattened, IMAGE_FEATURES, math.sqrt(2))
        width += IMAGE_FEATURES
    action = spec.action
    outputs = math.prod(action.shape) if action.kind == "box" else distribution(action).params_size
    acting += _mlp("actor", width, spec.net, outputs, gain=0.01)
    if action.kind == "box":
        acting.append(Field("actor.log_std", (outputs,), 0))
    return tuple(acting), tuple(_mlp("critic", width, spec.net, 1, gain=1.0))


def _mlp(name: str, width: int, hidden: Sequence[int], outputs: int, gain: float) -> list[Field]:
    fields: list[Field] = []
    for i, size in enumerate(hidden):
        fields += _linear(f"{name}.{i}", width, size, math.sqrt(2))
        width = size
    return fields + _linear(f"{name}.out", width, outputs, gain)


def _linear(name: str, inputs: int, outputs: int, gain: float) -> list[Field]:
    return [Field(f"{name}.weight", (outputs, inputs), gain), Field(f"{name}.bias", (outputs,), 0)]


def size(fields: Sequence[Field]) -> int:
    """How many numbers these fields hold."""
    return sum(math.prod(field.shape) for field in fields)


def views(flat: Array, fields: Sequence[Field]) -> dict[str, Array]:
    """Each field of a flat array, as a view."""
    found, at = {}, 0
    for field in fields:
        count = math.prod(field.shape)
        found[field.name] = flat[at : at + count].reshape(field.shape)
        at += count
    return found


def features(spec: PolicySpec, leaves: Sequence[Array]) -> Floats:
    """Leaves [..., *leaf] to features [..., D] float32: flattened, counts as one-hot, bytes divided by 255. No images."""
    plain = [(leaf, array) for leaf, array in zip(spec.observation, leaves, strict=True) if not leaf.is_image]
    parts = [_features(leaf, array) for leaf, array in plain]
    if len(parts) == 1:
        return parts[0]
    if not parts:
        lead = leaves[0].ndim - len(spec.observation[0].shape)
        return np.empty((*leaves[0].shape[:lead], 0), np.float32)
    return np.concatenate(parts, -1)


def _features(leaf: Leaf, array: Array) -> Floats:
    lead = array.shape[: array.ndim - len(leaf.shape)]
    if leaf.sizes:
        flat = array.reshape(*lead, len(leaf.sizes)) - np.asarray(leaf.start)
        return np.concatenate([np.eye(n, dtype=np.float32)[flat[..., i]] for i, n in enumerate(leaf.sizes)], -1)
    flat = array.reshape(*lead, math.prod(leaf.shape))
    if leaf.dtype == "uint8":
        return flat * np.float32(1 / 255)
    return flat.astype(np.float32, copy=False)


def measured_features(spec: PolicySpec) -> npt.NDArray[np.bool_]:
    """[D] True for features that are measurements (of a Box): only these are normalised."""
    plain = [leaf for leaf in spec.observation if not leaf.is_image]
    return np.concatenate([np.full(_leaf_features(leaf), leaf.kind == "box") for leaf in plain] or [np.zeros(0, bool)])


def normalized(x: Floats, mean: Floats, std: Floats) -> Floats:
    """(x − mean) / std, clipped to ±10."""
    return np.asarray(np.clip((x - mean) / std, -CLIP, CLIP))


def buffer_size(spec: PolicySpec) -> int:
    """Length of `Weights.buffers`: the observations' means, then their standard deviations, if they are normalised."""
    return 2 * feature_size(spec) if spec.normalize_observations else 0


class Policy(Protocol):
    """What a collector acts with. Leaves are [L, N, *leaf]; params are [L, N, P] float32."""

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Act with these from now on."""
        ...

    def __call__(self, leaves: Sequence[Array]) -> Floats:
        """Distribution parameters of the actions in these observations."""
        ...


class NumpyPolicy:
    """The forward pass of an MLP policy: tanh or ReLU layers, a linear head."""

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec
        self._fields, _ = layout(spec)
        self._layers: list[tuple[Floats, Floats]] = []
        self._log_std: Floats | None = None
        self._normal: tuple[Floats, Floats] | None = None

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Act with these from now on: views, no copies. Raises ValueError when the sizes do not fit the spec."""
        if parameters.shape != (size(self._fields),) or buffers.shape != (buffer_size(self.spec),):
            raise ValueError(
                f"weights expected {size(self._fields)} parameters and {buffer_size(self.spec)} buffers, "
                f"got {parameters.shape} and {buffers.shape}"
            )
        found = views(parameters, self._fields)
        names = [f"actor.{i}" for i in range(len(self.spec.net))] + ["actor.out"]
        self._layers = [(found[f"{name}.weight"].T, found[f"{name}.bias"]) for name in names]
        self._log_std = found.get("actor.log_std")
        if self.spec.normalize_observations:
            self._normal = (buffers[: len(buffers) // 2], buffers[len(buffers) // 2 :])

    def __call__(self, leaves: Sequence[Array]) -> Floats:
        """Distribution parameters [L, N, P] of the actions in these observations [L, N, *leaf]."""
        x = features(self.spec, leaves)
        if self._normal is not None:
            x = normalized(x, *self._normal)
        relu = self.spec.activation == "relu"
        *hidden, (weight, bias) = self._layers
        for w, b in hidden:
            x = np.matmul(x, w)
            x += b
            if relu:
                np.maximum(x, 0, out=x)
            else:
                np.tanh(x, out=x)
        x = np.asarray(np.matmul(x, weight))
        x += bias
        if self._log_std is None:
            return x
        return np.concatenate([x, np.broadcast_to(self._log_std, x.shape)], -1)


def make_policy(spec: PolicySpec) -> Policy:
    """What acts for this spec: numpy for an MLP; torch, imported only then, where there are images."""
    if not spec.needs_torch:
        return NumpyPolicy(spec)
    from protocol.networks import TorchPolicy

    return TorchPolicy(spec)
