"""The same policy in torch: what the learner learns with, and what a worker with images acts with.

Beside `encoder.py` the one file of protocol that imports torch. Every parameter stands where `protocol.policy.policy.layout`
says, in one flat float32 tensor, and every gradient in a second one; the named arrays are views into the two. So the
norm of the gradient is one norm, Adam is one kernel, and publishing is one copy of a prefix. Features come from
`protocol.policy.policy` (numpy), already normalised: one truth for what a network sees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from protocol.arrays import Array, Floats
from protocol.policy.distributions import LOG_SQRT_2PI
from protocol.policy.encoder import make_encoder
from protocol.policy.malloc import keep_freed
from protocol.policy.policy import (
    Field,
    buffer_fields,
    buffer_size,
    convolutions,
    features,
    hidden_names,
    layout,
    normalized,
    size,
    views,
)
from protocol.policy.recurrent import zero_state
from protocol.specs import ActionSpec, ImagesDtype, PolicySpec


class RecurrentInput(NamedTuple):
    """What a recurrent core needs in addition to the features of T steps of C env copies, in time order [T · C, …]."""

    initial_state: Tensor  # [C, S] float32, before the first step
    keep_state: Tensor  # [T, C] float32: 0 where an episode begins and the state is reset, else 1
    output_rows: Tensor | None = None  # [B] int64, the rows of T · C to return; None: all


class MLP(torch.autograd.Function):
    """Hidden layers and a linear head as one node of the graph: a small network's time is the graph's, not the arithmetic's.

    Forward: h₀ = x [B, D];  hᵢ = φ(hᵢ₋₁ Wᵢᵀ + bᵢ);  output = h Wᵀ + b [B, O].
    Backward: with g = ∂L/∂(pre-activation), ∂L/∂W = gᵀ h, ∂L/∂b = Σ g, ∂L/∂h = g W; φ' is 1 − h² (tanh) or h > 0 (ReLU).
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, relu: bool, *layers: Tensor) -> Tensor:
        """`layers` alternates weight [out, in] and bias [out]; the last pair is the head."""
        inputs = [x]
        *hidden, weight, bias = layers
        for w, b in zip(hidden[::2], hidden[1::2], strict=True):
            x = torch.addmm(b, x, w.t())
            inputs.append(x.relu_() if relu else x.tanh_())
        ctx.relu = relu
        ctx.save_for_backward(*inputs, *layers[::2])
        return torch.addmm(bias, x, weight.t())

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of x (if wanted) and of each layer's weight and bias."""
        (g,) = outputs
        half = len(ctx.saved_tensors) // 2
        inputs, weights = ctx.saved_tensors[:half], ctx.saved_tensors[half:]
        found: list[Tensor | None] = []
        for i in range(half - 1, 0, -1):
            found += [g.sum(0), g.t() @ inputs[i]]
            g = g @ weights[i]
            if ctx.relu:
                g = torch.ops.aten.threshold_backward(g, inputs[i], 0)
            else:
                g = torch.ops.aten.tanh_backward(g, inputs[i])
        found += [g.sum(0), g.t() @ inputs[0], None, g @ weights[0] if ctx.needs_input_grad[0] else None]
        return tuple(reversed(found))


class Convolutions(NamedTuple):
    """What an image goes through first, and the layer after it."""

    channels_last: bool
    parameters: list[tuple[Tensor, Tensor]]  # weight and bias of each convolution, then of the layer
    strides: list[int]
    narrow: bool = False  # parameters are bfloat16, the first ones divided by 255

    def narrowed(self) -> Convolutions:
        """With copies of the parameters, in bfloat16, and laid as it is fastest with: half the time of any other way."""
        (first, bias), *others = ((weight.to(torch.bfloat16), bias.to(torch.bfloat16)) for weight, bias in self.parameters)
        *convs, out = [(first / 255, bias), *others]
        laid = [(weight.contiguous(memory_format=torch.channels_last), bias) for weight, bias in convs]
        return self._replace(parameters=[*laid, out], narrow=True)

    def __call__(self, image: Tensor) -> Tensor:
        """Images [B, *leaf] uint8 -> features [B, IMAGE_FEATURES] float32, computed in the dtype of the parameters."""
        *convs, (weight, bias) = self.parameters
        h = (image.permute(0, 3, 1, 2) if self.channels_last else image).to(weight.dtype, copy=True)
        h = h.contiguous(memory_format=torch.channels_last) if self.narrow else h.mul_(1 / 255)
        for (w, b), stride in zip(convs, self.strides, strict=True):
            h = F.relu(F.conv2d(h, w, b, stride), inplace=True)
        return F.relu(F.linear(h.flatten(1), weight, bias)).float()


class FlatNetwork:
    """Named parameters that are views into one flat tensor, and the convolutions that images go through first."""

    def __init__(self, spec: PolicySpec, device: str | torch.device = "cpu", *, seed: int = 0) -> None:
        """Orthogonal initialisation with each field's gain, zeros where it is 0: the same for the same seed."""
        acting, critic = layout(spec)
        self.spec = spec
        self.fields = (*acting, *critic)
        self.acting_size = size(acting)
        self.flat = _initial(self.fields, seed).to(device)  # [P] float32: give this to the optimiser
        self.flat_grad = torch.zeros_like(self.flat)  # [P] float32: zero it before each backward pass
        self.flat.grad = self.flat_grad
        self.parameters: dict[str, Tensor] = {}  # leaves of the graph: views into `flat`, gradients into `flat_grad`
        at = 0
        for field in self.fields:
            end = at + math.prod(field.shape)
            view = self.flat[at:end].view(field.shape).detach().requires_grad_()
            view.grad = self.flat_grad[at:end].view(field.shape)
            self.parameters[field.name] = view
            at = end
        self._relu = spec.activation == "relu"
        self._encoder = None if spec.encoder is None else self._own(make_encoder(spec, seed).to(device))
        self._images = self._convolutions()
        if spec.needs_torch:
            keep_freed()

    def _own(self, encoder: torch.nn.Module) -> torch.nn.Module:
        """Let the encoder's parameters live where all others do; they keep their first values."""
        for name, parameter in encoder.named_parameters():
            place = self.parameters[f"encoder.{name}"]
            with torch.no_grad():
                place.copy_(parameter)
            parameter.data, parameter.grad = place.data, place.grad
            self.parameters[f"encoder.{name}"] = parameter
        return encoder

    def layers(self, names: Sequence[str]) -> list[Tensor]:
        """Weights and biases in turn, as `MLP` takes them."""
        return [self.parameters[f"{name}.{kind}"] for name in names for kind in ("weight", "bias")]

    def mlp(self, x: Tensor, layers: Sequence[Tensor]) -> Tensor:
        """Hidden layers with the activation between them, the last one linear."""
        out: Tensor = MLP.apply(x, self._relu, *layers)  # type: ignore[no-untyped-call]
        return out

    def hidden(self, x: Tensor, layers: Sequence[Tensor]) -> Tensor:
        """Hidden layers, each with its activation."""
        if not layers:
            return x
        out = self.mlp(x, layers)
        return torch.relu(out) if self._relu else torch.tanh(out)

    def narrow_convolutions(self) -> None:
        """From now on look at images in bfloat16, under the parameters as they are now; without gradient."""
        with torch.no_grad():
            self._images = [image.narrowed() for image in self._convolutions()]

    def _convolutions(self) -> list[Convolutions]:
        """Of each image, under the parameters themselves."""
        images = [i for i, leaf in enumerate(self.spec.observation) if leaf.is_image]
        return [] if self._encoder else [self._image(i) for i in images]

    def _image(self, i: int) -> Convolutions:
        leaf = self.spec.observation[i]
        stack, (channels, _, _), _ = convolutions(leaf)
        names = [f"image{i}.{j}" for j in range(len(stack))] + [f"image{i}.out"]
        parameters = [(self.parameters[f"{name}.weight"], self.parameters[f"{name}.bias"]) for name in names]
        return Convolutions(leaf.shape != (channels, *leaf.shape[1:]), parameters, [conv.stride for conv in stack])

    def inputs(self, x: Tensor, images: Sequence[Tensor]) -> Tensor:
        """Features [B, D] and images [B, *leaf] uint8 -> what the MLPs take [B, D + IMAGE_FEATURES per image].

        Or [B, K], what the encoder makes of them.
        """
        if self._encoder is not None:
            out: Tensor = self._encoder(x, *images)
            return out
        parts = [x]
        parts += [convolutions(image) for convolutions, image in zip(self._images, images, strict=True)]
        return torch.cat(parts, -1) if images else x

    def core(self, x: Tensor, recurrent: RecurrentInput) -> tuple[Tensor, Tensor]:
        """Inputs [T · C, D] -> what the core says of them [T · C, H], and its state after the last [C, S]; see `core.py`."""
        weights = [self.parameters[f"core.{side}.{kind}"] for kind in ("weight", "bias") for side in ("input", "state")]
        found, state = [], recurrent.initial_state
        for step, keep in zip(x.view(*recurrent.keep_state.shape, -1), recurrent.keep_state.unsqueeze(-1), strict=True):
            state = state * keep
            if self.spec.core == "lstm":
                h, c = torch.lstm_cell(step, state.chunk(2, -1), *weights)
                state = torch.cat((h, c), -1)
            else:
                h = state = torch.gru_cell(step, state, *weights)
            found.append(h)
        return torch.cat(found), state


class ActorCriticNetwork(FlatNetwork):
    """An actor and a critic: an MLP each, or two heads on one; both on one core, if there is one."""

    def __init__(self, spec: PolicySpec, device: str | torch.device = "cpu", *, seed: int = 0) -> None:
        super().__init__(spec, device, seed=seed)
        trunk = hidden_names(spec)
        self._trunk = self.layers(trunk) if spec.shared_net else []
        self._actor = self.layers(["actor.out"] if spec.shared_net else [*trunk, "actor.out"])
        self._critic = self.layers(["critic.out"] if spec.shared_net else [*hidden_names(spec, "critic"), "critic.out"])

    def _params(self, h: Tensor) -> Tensor:
        out = self.mlp(h, self._actor)
        if self.spec.action.kind != "box":
            return out
        return torch.cat([out, self.parameters["actor.log_std"].expand_as(out)], -1)

    def _common(self, x: Tensor, images: Sequence[Tensor], recurrent: RecurrentInput | None) -> Tensor:
        h = self.inputs(x, images)
        if recurrent is not None:
            h, _ = self.core(h, recurrent)
            h = h if recurrent.output_rows is None else h[recurrent.output_rows]
        return self.hidden(h, self._trunk)

    def forward(
        self, x: Tensor, images: Sequence[Tensor] = (), recurrent: RecurrentInput | None = None
    ) -> tuple[Tensor, Tensor]:
        """Features [B, D] float32 and images [B, *leaf] uint8 -> distribution params [B, P], value [B].

        With a core, x and images are [T · C, …], and `recurrent` says where episodes begin and which B rows to return.
        """
        h = self._common(x, images, recurrent)
        return self._params(h), self.mlp(h, self._critic)[:, 0]

    def params(self, x: Tensor, images: Sequence[Tensor] = (), recurrent: RecurrentInput | None = None) -> Tensor:
        """Distribution params [B, P] alone."""
        return self._params(self._common(x, images, recurrent))

    def value(self, x: Tensor, images: Sequence[Tensor] = (), recurrent: RecurrentInput | None = None) -> Tensor:
        """Value [B] alone."""
        return self.mlp(self._common(x, images, recurrent), self._critic)[:, 0]

    def act(self, x: Tensor, images: Sequence[Tensor], state: Tensor) -> tuple[Tensor, Tensor]:
        """Distribution params [B, P] of one step of B copies, and the core's state after it [B, S]."""
        h = self.inputs(x, images)
        if self.spec.core is not None:
            h, state = self.core(h, RecurrentInput(state, x.new_ones(1, len(x))))
        return self._params(self.hidden(h, self._trunk)), state


class QNetwork(FlatNetwork):
    """The value of every action, plain or dueling."""

    def __init__(self, spec: PolicySpec, device: str | torch.device = "cpu", *, seed: int = 0) -> None:
        super().__init__(spec, device, seed=seed)
        self._plain = self.layers([*hidden_names(spec), "q.out"])
        self._hidden = self.layers(hidden_names(spec))

    def params(self, x: Tensor, images: Sequence[Tensor] = ()) -> Tensor:
        """Action values [B, n] of features [B, D] float32 and images [B, *leaf] uint8."""
        h = self.inputs(x, images)
        if not self.spec.dueling:
            return self.mlp(h, self._plain)
        h = self.hidden(h, self._hidden)
        advantage, value = self.mlp(h, self.layers(["q.out"])), self.mlp(h, self.layers(["q.value"]))
        return value + advantage - advantage.mean(-1, keepdim=True)


def _initial(fields: Sequence[Field], seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for field in fields:
        part = torch.zeros(field.shape)
        if field.gain:
            torch.nn.init.orthogonal_(part, field.gain, generator)
        parts.append(part.flatten())
    return torch.cat(parts)


def log_prob_and_entropy(spec: ActionSpec, params: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Of actions [B, *action] under params [B, P]: log π(action) [B] and the entropy of π [B]; see `distributions`."""
    match spec.kind:
        case "discrete":
            return _categorical(params, action)
        case "multidiscrete":
            parts = zip(params.split_with_sizes(spec.sizes, -1), action.reshape(len(params), -1).unbind(-1), strict=True)
            log_probs, entropies = zip(*(_categorical(logits, choice) for logits, choice in parts), strict=True)
            return torch.stack(log_probs).sum(0), torch.stack(entropies).sum(0)
        case "multibinary":
            bits = action.reshape(params.shape).to(params.dtype)
            softplus = F.softplus(params)
            return (bits * params - softplus).sum(-1), (softplus - params * torch.sigmoid(params)).sum(-1)
        case "box":
            mean, log_std = params.chunk(2, -1)
            z = (action.reshape(mean.shape) - mean) * torch.exp(-log_std)
            return (-0.5 * z * z - log_std - LOG_SQRT_2PI).sum(-1), (log_std + (0.5 + LOG_SQRT_2PI)).sum(-1)


def _categorical(logits: Tensor, choice: Tensor) -> tuple[Tensor, Tensor]:
    log_probs = F.log_softmax(logits, -1)
    return log_probs.gather(-1, choice[:, None])[:, 0], -(log_probs.exp() * log_probs).sum(-1)


class TorchPolicy:
    """Acts as `NumpyPolicy` does, with images. Lanes go one at a time, so each gets the bits it would get alone."""

    def __init__(
        self, spec: PolicySpec, device: str = "cpu", *, together: bool = False, images: ImagesDtype = "float32"
    ) -> None:
        """`together`: all lanes in one pass, for whoever always has all of them. `images`: as what it looks at them."""
        self.spec = spec
        self._images = images
        self._device, self._together = device, together
        self._net = QNetwork(spec, device) if spec.head == "q" else ActorCriticNetwork(spec, device)
        self._buffers: dict[str, Floats] = {}

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Act with these from now on. Raises ValueError when the sizes do not fit the spec."""
        count = self._net.acting_size
        if parameters.shape != (count,) or buffers.shape != (buffer_size(self.spec),):
            raise ValueError(
                f"weights expected {count} parameters and {buffer_size(self.spec)} buffers, "
                f"got {parameters.shape} and {buffers.shape}"
            )
        self._net.flat[:count].copy_(torch.tensor(parameters))
        if self._images == "bfloat16":
            self._net.narrow_convolutions()
        self._buffers = views(buffers, buffer_fields(self.spec))

    def __call__(self, leaves: Sequence[Array], state: Floats | None = None) -> Floats:
        """Distribution parameters [L, N, P] of the actions in these observations [L, N, *leaf]; see `Policy`."""
        x = features(self.spec, leaves)
        if self.spec.normalize_observations:
            x = normalized(x, self._buffers["observation_mean"], self._buffers["observation_std"])
        images = [array for leaf, array in zip(self.spec.observation, leaves, strict=True) if leaf.is_image]
        state = zero_state(self.spec, *x.shape[:-1]) if state is None else state
        if self._together:
            L, N = x.shape[:2]
            remembered = state.reshape(L * N, -1)
            flat = self._lane(x.reshape(L * N, -1), [image.reshape(L * N, *image.shape[2:]) for image in images], remembered)
            out, state[...] = flat.reshape(L, N, -1), remembered.reshape(state.shape)
        else:
            out = np.stack([self._lane(x[lane], [image[lane] for image in images], state[lane]) for lane in range(len(x))])
        if self.spec.head != "q":
            return out
        return np.concatenate([out, np.broadcast_to(self._buffers["epsilon"], (*out.shape[:-1], 1))], -1)

    def _lane(self, x: Floats, images: Sequence[Array], state: Floats) -> Floats:
        """Of one lane: [N, D], [N, *leaf] each, [N, S], which is moved on -> [N, P]."""
        inputs = torch.tensor(x, device=self._device), [torch.tensor(image, device=self._device) for image in images]
        with torch.no_grad():
            if isinstance(self._net, QNetwork):
                return np.asarray(self._net.params(*inputs).cpu().numpy())
            params, after = self._net.act(*inputs, torch.tensor(state, device=self._device))
        state[:] = after.cpu().numpy()
        return np.asarray(params.cpu().numpy())
