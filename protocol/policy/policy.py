"""Acting: the flat parameter layout, features, and the numpy forward pass of MLP policies. Pure; imports no torch.

All parameters of a policy live in one flat float32 buffer, the acting part first, so that publishing is one copy of a
prefix and loading is views on the received frame. `layout` is the one place that says where each array stands; the torch
modules of `protocol.policy.networks` are views into the same layout.

Forward passes work on lanes side by side, [L, N, ·]: numpy's stacked matmul gives each lane the bits it would get alone,
which is what makes a run independent of the number of its workers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from protocol.arrays import Array, Floats
from protocol.policy.distributions import distribution
from protocol.policy.recurrent import advance, core_shapes, zero_state
from protocol.specs import ImagesDtype, Leaf, PolicySpec

CLIP = np.float32(10.0)  # normalised observations are clipped to ±10
IMAGE_FEATURES = 128  # width of the layer between the convolutions of one image and the rest


class Field(NamedTuple):
    """One array of the flat buffer."""

    name: str
    shape: tuple[int, ...]
    gain: float
    """of the orthogonal initialisation; 0: starts at zero (biases, log standard deviations) or by itself (encoders)"""


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
    if spec.encoder is not None:
        acting += [Field(f"encoder.{array.name}", array.shape, 0) for array in spec.encoder.arrays]
        width = spec.encoder.size
    for i, leaf in enumerate(spec.observation):
        if not leaf.is_image or spec.encoder is not None:
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
    if spec.core is not None:
        from_input, from_state = core_shapes(spec, width)
        acting += [*_linear("core.input", *from_input[::-1], 1.0), *_linear("core.state", *from_state[::-1], 1.0)]
        width = spec.core_size
    hidden, last = _hidden(_trunk(spec), width, spec.net)
    acting += hidden
    action = spec.action
    if spec.head == "q":
        if spec.dueling:
            acting += _linear("q.value", last, 1, 1.0)
        return tuple(acting + _linear("q.out", last, action.sizes[0], 1.0)), ()
    outputs = math.prod(action.shape) if action.kind == "box" else distribution(spec).params_size
    acting += _linear("actor.out", last, outputs, 0.01)
    if action.kind == "box":
        acting.append(Field("actor.log_std", (outputs,), 0))
    critic, last = ([], last) if spec.shared_net else _hidden("critic", width, spec.net)
    return tuple(acting), (*critic, *_linear("critic.out", last, 1, 1.0))


def _trunk(spec: PolicySpec) -> str:
    """Name of the hidden layers that acting goes through."""
    return "q" if spec.head == "q" else "shared" if spec.shared_net else "actor"


def hidden_names(spec: PolicySpec, name: str = "") -> list[str]:
    """Names of the hidden layers that acting goes through, or of those of `critic`."""
    return [f"{name or _trunk(spec)}.{i}" for i in range(len(spec.net))]


def _hidden(name: str, width: int, sizes: Sequence[int]) -> tuple[list[Field], int]:
    """Hidden layers, and the width of the last one."""
    fields: list[Field] = []
    for i, size in enumerate(sizes):
        fields += _linear(f"{name}.{i}", width, size, math.sqrt(2))
        width = size
    return fields, width


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


def buffer_fields(spec: PolicySpec) -> tuple[Field, ...]:
    """What `Weights.buffers` holds: the observations' means and standard deviations, if they are normalised; then ε."""
    fields: list[Field] = []
    if spec.normalize_observations:
        fields += [Field(name, (feature_size(spec),), 0) for name in ("observation_mean", "observation_std")]
    if spec.head == "q":
        fields.append(Field("epsilon", (1,), 0))
    return tuple(fields)


def buffer_size(spec: PolicySpec) -> int:
    """Length of `Weights.buffers`."""
    return size(buffer_fields(spec))


class Policy(Protocol):
    """What a collector acts with. Leaves are [L, N, *leaf]; params are [L, N, P] float32.

    `state` [L, N, S] float32 is what a policy with a core remembers, and is moved on in place (`protocol.policy.recurrent`).
    """

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Act with these from now on."""
        ...

    def __call__(self, leaves: Sequence[Array], state: Floats | None = None) -> Floats:
        """Distribution parameters of the actions in these observations. No state: the first of their episodes."""
        ...


class NumpyPolicy:
    """The forward pass of an MLP policy: a core if it has one, tanh or ReLU layers, a linear head."""

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec
        self._fields, _ = layout(spec)
        self._parameters: dict[str, Floats] = {}
        self._buffers: dict[str, Floats] = {}
        leaf, *more = spec.observation
        self._as_they_are = not more and (leaf.kind, leaf.dtype, len(leaf.shape)) == ("box", "float32", 1)
        self._between: list[Floats] = []  # [L, N, width] what each hidden layer gives, overwritten in each pass

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Act with these from now on: views, no copies. Raises ValueError when the sizes do not fit the spec."""
        if parameters.shape != (size(self._fields),) or buffers.shape != (buffer_size(self.spec),):
            raise ValueError(
                f"weights expected {size(self._fields)} parameters and {buffer_size(self.spec)} buffers, "
                f"got {parameters.shape} and {buffers.shape}"
            )
        self._parameters = views(parameters, self._fields)
        self._buffers = views(buffers, buffer_fields(self.spec))
        self._hidden = [self._linear(name) for name in hidden_names(self.spec)]
        self._out = self._linear("q.out" if self.spec.head == "q" else "actor.out")
        self._beside = self._parameters.get("actor.log_std", self._buffers.get("epsilon"))

    def _linear(self, name: str) -> tuple[Floats, Floats]:
        return self._parameters[f"{name}.weight"].T, self._parameters[f"{name}.bias"]

    def __call__(self, leaves: Sequence[Array], state: Floats | None = None) -> Floats:
        """Distribution parameters [L, N, P] of the actions in these observations [L, N, *leaf]; see `Policy`."""
        x = leaves[0] if self._as_they_are else features(self.spec, leaves)
        if self.spec.normalize_observations:
            x = normalized(x, self._buffers["observation_mean"], self._buffers["observation_std"])
        if self.spec.core is not None:
            x = advance(self.spec, self._parameters, x, zero_state(self.spec, *x.shape[:-1]) if state is None else state)
        if not self._between or self._between[0].shape[:-1] != x.shape[:-1]:
            self._between = [np.empty((*x.shape[:-1], width), np.float32) for width in self.spec.net]
        relu = self.spec.activation == "relu"
        for (weight, bias), out in zip(self._hidden, self._between, strict=True):
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
        if self.spec.dueling:
            weight, bias = self._linear("q.value")
            out += np.matmul(x, weight) + bias - out.mean(-1, keepdims=True)
        if self._beside is None:
            return out
        width = out.shape[-1]
        params = np.empty((*out.shape[:-1], width + len(self._beside)), np.float32)
        params[..., :width], params[..., width:] = out, self._beside
        return params


def make_policy(spec: PolicySpec, images: ImagesDtype = "float32") -> Policy:
    """What acts for this spec: numpy for an MLP; torch, imported only then, where there are images.

    `images`: as what it looks at them.
    """
    if not spec.needs_torch:
        return NumpyPolicy(spec)
    from protocol.policy.networks import TorchPolicy

    return TorchPolicy(spec, images=images)
