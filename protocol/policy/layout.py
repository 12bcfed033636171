"""The position of each parameter in the flat buffer. Pure; imports no torch.

All parameters of a policy are in one flat float32 buffer. The parameters that are needed to act come first, so publishing
weights copies only the first part of the buffer. Loading weights makes views of the received frame. Only `parameter_layout`
defines the positions. The parameters of the networks in torch are views with the same layout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.policy.features import critic_size, feature_size
from millrace.protocol.policy.heads import HEADS
from millrace.protocol.policy.recurrent import core_shapes
from millrace.protocol.specs import Leaf, PolicySpec

FlatT = TypeVar("FlatT", bound=Any)
"""a numpy array, or, where torch is imported anyway, a torch tensor"""
IMAGE_FEATURES = 128  # width of the linear layer after the convolutions of one image


class Field(NamedTuple):
    """One array of the flat buffer."""

    name: str
    shape: tuple[int, ...]
    gain: float
    """gain of the orthogonal initialization; 0 if the array starts at zero (biases, log standard deviations), or is
    initialized by user code
    """


class Conv(NamedTuple):
    """One convolution: its output channels, kernel size and stride."""

    channels: int
    kernel: int
    stride: int

    def output_side(self, side: int) -> int:
        """The height or width of the output, from that of the input."""
        return (side - self.kernel) // self.stride + 1


CRITICS = ("critic0", "critic1")  # the critics of SAC and TD3; the input of each is the features and the action
LOG_STD_BOUNDS = (-20.0, 2.0)  # bounds for the log standard deviation of a squashed Gaussian (Haarnoja et al. 2018)
NATURE = (Conv(32, 8, 4), Conv(64, 4, 2), Conv(64, 3, 1))  # Mnih et al. 2015
SMALL = (Conv(16, 3, 1), Conv(32, 3, 2))


def convolutions(leaf: Leaf) -> tuple[tuple[Conv, ...], tuple[int, int, int], int]:
    """For an image: its convolutions, its shape as (channels, height, width), and the size of the flattened output.

    The channels are the last dimension, unless it is larger than the first. If both sides of the image have at least 36
    pixels, the convolutions are those of Mnih et al. (2015); otherwise, they are two 3 x 3 convolutions.
    """
    chw = (leaf.shape[2], *leaf.shape[:2]) if leaf.has_channels_last else leaf.shape
    stack = NATURE if min(chw[1:]) >= 36 else SMALL
    height, width = chw[1:]
    for conv in stack:
        height = conv.output_side(height)
        width = conv.output_side(width)
    return stack, (chw[0], chw[1], chw[2]), stack[-1].channels * height * width


def parameter_layout(spec: PolicySpec) -> tuple[tuple[Field, ...], tuple[Field, ...]]:
    """The fields that are needed to act, and the fields of the critics. Linear weights are [out, in].

    For actions in [-1, 1], the encoder comes last among the acting fields, right before the critics, because it is trained
    only by the critic losses.
    """
    if spec.own is not None:
        return tuple(Field(array.name, array.shape, 0) for array in spec.own.arrays), ()
    encoder, width = encoder_layout(spec)
    acting = [] if spec.stores_scaled_actions else [*encoder]
    hidden, last = _hidden(_trunk(spec), width, spec.net)
    acting += hidden
    action = spec.action
    if spec.head == "q":
        if spec.dueling:
            acting += _linear("q.value", last, 1, 1.0)
        return tuple(acting + _linear("q.out", last, action.sizes[0], 1.0)), ()
    size = math.prod(action.shape)
    if spec.stores_scaled_actions:
        acting += _linear("actor.out", last, 2 * size if HEADS[spec.head].has_log_std_outputs else size, 0.01)
        acting += encoder
        critics = [
            field
            for name in CRITICS
            for hidden, last in [_hidden(name, width + size, spec.net)]
            for field in (*hidden, *_linear(f"{name}.out", last, 1, 1.0))
        ]
        return tuple(acting), tuple(critics)
    acting += _linear("actor.out", last, action.choices + action.bits + action.numbers, 0.01)
    if action.numbers:
        acting.append(Field("actor.log_std", (action.numbers,), 0))
    critic, last = ([], last) if spec.shared_net else _hidden("critic", width + critic_size(spec), spec.net)
    return tuple(acting), (*critic, *_linear("critic.out", last, 1, 1.0))


def encoder_layout(spec: PolicySpec) -> tuple[list[Field], int]:
    """The fields of the layers before the hidden layers, and the number of features that these layers output.

    These layers are the convolutions of each image, or the user-defined module; then the recurrent core, if there is one.
    """
    fields: list[Field] = []
    width = feature_size(spec)
    if spec.encoder is not None:
        fields += [Field(f"encoder.{array.name}", array.shape, 0) for array in spec.encoder.arrays]
        width = spec.encoder.size
    for i, leaf in enumerate(spec.observation):
        if not leaf.is_image or spec.encoder is not None:
            continue
        stack, (channels, _, _), flattened = convolutions(leaf)
        for j, conv in enumerate(stack):
            weight = (conv.channels, channels, conv.kernel, conv.kernel)
            fields += [
                Field(f"image{i}.{j}.weight", weight, math.sqrt(2)),
                Field(f"image{i}.{j}.bias", (conv.channels,), 0),
            ]
            channels = conv.channels
        fields += _linear(f"image{i}.out", flattened, IMAGE_FEATURES, math.sqrt(2))
        width += IMAGE_FEATURES
    if spec.core is not None:
        from_input, from_state = core_shapes(spec, width)
        fields += [*_linear("core.input", *from_input[::-1], 1.0), *_linear("core.state", *from_state[::-1], 1.0)]
        width = spec.core_size
    return fields, width


def _trunk(spec: PolicySpec) -> str:
    """The name prefix of the hidden layers that are needed to act."""
    return "shared" if spec.shared_net else HEADS[spec.head].prefix


def hidden_names(spec: PolicySpec, name: str = "") -> list[str]:
    """The names of the hidden layers that are needed to act, or of those with another prefix `name`, such as `critic`."""
    return [f"{name or _trunk(spec)}.{i}" for i in range(len(spec.net))]


def _hidden(name: str, width: int, sizes: Sequence[int]) -> tuple[list[Field], int]:
    """The fields of hidden layers of these sizes, and the width of the last one. `width` is the size of their input."""
    fields: list[Field] = []
    for i, size in enumerate(sizes):
        fields += _linear(f"{name}.{i}", width, size, math.sqrt(2))
        width = size
    return fields, width


def _linear(name: str, inputs: int, outputs: int, gain: float) -> list[Field]:
    return [Field(f"{name}.weight", (outputs, inputs), gain), Field(f"{name}.bias", (outputs,), 0)]


def acting_size(spec: PolicySpec) -> int:
    """Length of `Weights.parameters`: the fields needed to act."""
    return total_size(parameter_layout(spec)[0])


def total_size(fields: Sequence[Field]) -> int:
    """The total number of parameters in these fields."""
    return sum(math.prod(field.shape) for field in fields)


def named_views(flat: FlatT, fields: Sequence[Field]) -> dict[str, FlatT]:
    """A view of each field of a flat array or tensor, by name."""
    views = dict[str, FlatT]()
    at = 0
    for field in fields:
        count = math.prod(field.shape)
        views[field.name] = flat[at : at + count].reshape(field.shape)
        at += count
    return views


def buffer_layout(spec: PolicySpec) -> tuple[Field, ...]:
    """The fields of `Weights.buffers`: statistics of observations, if these are normalized, and parameters of exploration.

    With Q-values, the only exploration parameter is ε. With actions in [-1, 1], the exploration parameters are the scale of
    the noise (only if actions are deterministic), and a number that is 1 during the warm-up, while actions are drawn
    uniformly, and 0 afterwards.
    """
    fields: list[Field] = []
    if spec.normalize_observations:
        fields += [Field(name, (feature_size(spec),), 0) for name in ("observation_mean", "observation_std")]
    return (*fields, *(Field(name, (1,), 0) for name in HEADS[spec.head].exploration))


def appended_params(spec: PolicySpec, parameters: Mapping[str, Array], buffers: Mapping[str, Array]) -> Array | None:
    """What follows a network's outputs in the distribution params [K]: log standard deviations, or exploration parameters.

    None if there is neither. `parameters` and `buffers` are the arrays of the policy's weights, by name.
    """
    log_std = parameters.get("actor.log_std")
    appended = [] if log_std is None else [log_std]
    appended += [buffers[name] for name in HEADS[spec.head].exploration]
    return np.concatenate(appended) if appended else None


def buffer_size(spec: PolicySpec) -> int:
    """Length of `Weights.buffers`."""
    return total_size(buffer_layout(spec))
