"""The layers before the hidden layers: the convolutions of each image or the user-defined module, then the recurrent core.

All networks of a policy have this encoder, and their heads share its output. Its parameters are views of the network's flat
tensor, in the layout of `encoder_layout`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from millrace.protocol.policy.layout import convolutions
from millrace.protocol.policy.own_encoder import make_encoder
from millrace.protocol.specs import PolicySpec


class RecurrentInput(NamedTuple):
    """What a recurrent core needs besides the features of T steps of C env copies, which are [T · C, …] in time order."""

    initial_state: Tensor  # [C, S] float32, before the first step
    keep_state: Tensor  # [T, C] float32: 0 where an episode begins and the state is reset, else 1
    output_rows: Tensor | None = None  # [B] int64, the rows of T · C to return; None: all
    advances: Tensor | None = None  # [T, C] bool: False where the row leaves the state as it was; None: True everywhere

    def part(self, steps: int, columns: Tensor | slice, output_rows: Tensor | None = None) -> RecurrentInput:
        """The input for the first steps of some columns."""
        advances = None if self.advances is None else self.advances[:steps, columns]
        return RecurrentInput(self.initial_state[columns], self.keep_state[:steps, columns], output_rows, advances)


class Convolutions(NamedTuple):
    """The convolutions of one image, and the linear layer after them."""

    channels_last: bool
    parameters: list[tuple[Tensor, Tensor]]  # weight and bias of each convolution, then of the linear layer
    strides: list[int]
    divisor: int  # values of the image are divided by this
    bfloat16: bool = False  # parameters are bfloat16, and the first weight is divided by `divisor`

    def in_bfloat16(self) -> Convolutions:
        """A copy with bfloat16 parameters, in channels-last format, which takes half the time of other formats."""
        (first, bias), *others = ((weight.to(torch.bfloat16), bias.to(torch.bfloat16)) for weight, bias in self.parameters)
        *convs, out = [(first / self.divisor, bias), *others]
        channels_last = [(weight.contiguous(memory_format=torch.channels_last), bias) for weight, bias in convs]
        return self._replace(parameters=[*channels_last, out], bfloat16=True)

    def __call__(self, image: Tensor) -> Tensor:
        """Images [B, *leaf] uint8 -> features [B, IMAGE_FEATURES] float32, computed in the dtype of the parameters."""
        *convs, (weight, bias) = self.parameters
        h = image.permute(0, 3, 1, 2) if self.channels_last else image
        if torch.is_grad_enabled() and weight.requires_grad and image.device.type == "cpu":
            # On a CPU, channels-last reduces the time of the backward pass to two thirds; a forward pass alone isn't faster.
            h = h.contiguous(memory_format=torch.channels_last)
            convs = [(w.contiguous(memory_format=torch.channels_last), b) for w, b in convs]
        h = h.to(weight.dtype, copy=True)
        h = h.contiguous(memory_format=torch.channels_last) if self.bfloat16 else h.mul_(1 / self.divisor)
        for (w, b), stride in zip(convs, self.strides, strict=True):
            h = F.relu(F.conv2d(h, w, b, stride), inplace=True)
        return F.relu(F.linear(h.flatten(1), weight, bias)).float()


class Encoder:
    """The layers before the MLPs: the convolutions of each image or the user-defined module, then the recurrent core."""

    def __init__(self, spec: PolicySpec, parameters: dict[str, Tensor], device: str | torch.device, *, seed: int) -> None:
        """`parameters` has tensors by name; to train the encoder, pass leaves of autograd's graph. Tensors of a user-defined
        module are replaced by the module's own parameters, which then use the same memory.
        """
        self._spec = spec
        self._parameters = parameters
        self._module = None if spec.encoder is None else self._adopt(make_encoder(spec, seed).to(device))
        self._images = self._convolutions()

    def __call__(self, x: Tensor, images: Sequence[Tensor], recurrent: RecurrentInput | None = None) -> Tensor:
        """Features [B, D] and images [B, *leaf] uint8 -> input of the MLPs [B, D + IMAGE_FEATURES per image].

        With a user-defined module, the input of the MLPs is the module's output [B, K].

        With a recurrent core, x and images are [T · C, …], and the input of the MLPs is the core's output [B, H].
        `recurrent` says where episodes begin and which B rows to return; if it is None, each observation is the first of its
        episode.
        """
        if self._spec.core is None:
            return self._seen(x, images)
        h, _ = self.advance(x, images, self._first_steps(x) if recurrent is None else recurrent)
        return h if recurrent is None or recurrent.output_rows is None else h[recurrent.output_rows]

    def advance(self, x: Tensor, images: Sequence[Tensor], recurrent: RecurrentInput) -> tuple[Tensor, Tensor]:
        """The core's outputs [T · C, H] for x and images of [T · C, …], and its last state [C, S]."""
        return self.core(self._seen(x, images), recurrent)

    def act(self, x: Tensor, images: Sequence[Tensor], state: Tensor) -> tuple[Tensor, Tensor]:
        """The input of the MLPs for one step of B copies, and the core's state [B, S] after it. Without a core, `state` is
        returned unchanged.
        """
        if self._spec.core is None:
            return self._seen(x, images), state
        return self.advance(x, images, RecurrentInput(state, x.new_ones(1, len(x))))

    def _first_steps(self, x: Tensor) -> RecurrentInput:
        return RecurrentInput(x.new_zeros(len(x), self._spec.state_size), x.new_ones(1, len(x)))

    def _seen(self, x: Tensor, images: Sequence[Tensor]) -> Tensor:
        if self._module is not None:
            out: Tensor = self._module(x, *images)
            return out
        parts = [x]
        parts += [convolutions(image) for convolutions, image in zip(self._images, images, strict=True)]
        return torch.cat(parts, -1) if images else x

    def core(self, x: Tensor, recurrent: RecurrentInput) -> tuple[Tensor, Tensor]:
        """Inputs [T · C, D] -> the core's outputs [T · C, H] and its last state [C, S]; see `recurrent.py`."""
        weights = [self._parameters[f"core.{side}.{kind}"] for kind in ("weight", "bias") for side in ("input", "state")]
        outputs = []
        state = recurrent.initial_state
        advances = recurrent.advances
        keeps = recurrent.keep_state.unsqueeze(-1)
        for t, (step, keep) in enumerate(zip(x.view(*recurrent.keep_state.shape, -1), keeps, strict=True)):
            before = state = state * keep
            if self._spec.core == "lstm":
                h, c = torch.lstm_cell(step, state.chunk(2, -1), *weights)
                state = torch.cat((h, c), -1)
            else:
                h = state = torch.gru_cell(step, state, *weights)
            if advances is not None:
                state = torch.where(advances[t, :, None], state, before)
            outputs.append(h)
        return torch.cat(outputs), state

    def use_bfloat16(self) -> None:
        """Process images in bfloat16 from now on, with copies of the current parameters and without gradients."""
        with torch.no_grad():
            self._images = [image.in_bfloat16() for image in self._convolutions()]

    def _adopt(self, module: torch.nn.Module) -> torch.nn.Module:
        """Move the module's parameters into the memory of the flat tensor; they keep their initial values."""
        for name, parameter in module.named_parameters():
            view = self._parameters[f"encoder.{name}"]
            with torch.no_grad():
                view.copy_(parameter)
            parameter.data = view.data
            parameter.grad = view.grad
            self._parameters[f"encoder.{name}"] = parameter
        return module

    def _convolutions(self) -> list[Convolutions]:
        """The convolutions of each image, with views of the parameters."""
        images = [i for i, leaf in enumerate(self._spec.observation) if leaf.is_image]
        return [] if self._module else [self._image(i) for i in images]

    def _image(self, i: int) -> Convolutions:
        leaf = self._spec.observation[i]
        stack, (channels, _, _), _ = convolutions(leaf)
        names = [f"image{i}.{j}" for j in range(len(stack))] + [f"image{i}.out"]
        parameters = [(self._parameters[f"{name}.weight"], self._parameters[f"{name}.bias"]) for name in names]
        channels_last = leaf.shape != (channels, *leaf.shape[1:])
        return Convolutions(channels_last, parameters, [conv.stride for conv in stack], leaf.divisor)
