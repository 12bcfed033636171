"""The networks that the learner trains, in torch. Workers act with the first part of their parameters.

All parameters are in one flat float32 tensor, in the layout of `millrace.protocol.policy.layout`, and all gradients in a
second one. The named arrays are views of these two tensors, so the gradient norm is the norm of one tensor, an Adam step is
one kernel, and publishing copies the first part of one tensor. Features come from `millrace.protocol.policy.features`
(numpy) and are already normalized.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional as F

from millrace.learner.algorithms.bodies.autograd_leaves import named_leaves, trainable
from millrace.learner.algorithms.bodies.mlp_nodes import MLPNode, StackedMLPNode
from millrace.protocol.arrays import Floats
from millrace.protocol.policy.encoder import Encoder, RecurrentInput
from millrace.protocol.policy.features import feature_size
from millrace.protocol.policy.layout import (
    CRITICS,
    LOG_STD_BOUNDS,
    Field,
    encoder_layout,
    hidden_names,
    parameter_layout,
    total_size,
)
from millrace.protocol.policy.malloc import keep_freed_memory
from millrace.protocol.policy.masks import FORBIDDEN
from millrace.protocol.policy.torch_distributions import log_prob_and_entropy, squashed_sample
from millrace.protocol.random_streams import Purpose, torch_seed
from millrace.protocol.specs import PolicySpec

DTYPE = torch.float32
"""dtype of all parameters, whatever PyTorch's default dtype is"""


class FlatNetwork:
    """Base of all networks: named parameters that are views of one flat tensor, and the layers before the heads."""

    def __init__(self, spec: PolicySpec, device: str | torch.device = "cpu", *, seed: int = 0) -> None:
        """Initialize each field orthogonally with its gain, or with zeros if the gain is 0. The values depend on `seed`."""
        acting, critic = parameter_layout(spec)
        self.spec = spec
        self.fields = (*acting, *critic)
        self.acting_size = total_size(acting)
        self.acting_fields = len(acting)
        generator = torch.Generator().manual_seed(torch_seed(seed, Purpose.WEIGHTS))
        self.flat = initial_fields(self.fields, generator).to(device)
        """[P] float32: pass this to the optimizer"""
        self.flat_grad = torch.zeros_like(self.flat)  # [P] float32: zero it before each backward pass
        self.flat.grad = self.flat_grad
        self.parameters = named_leaves(self.flat, self.flat_grad, self.fields)
        self._relu = spec.activation == "relu"
        self.encode = Encoder(spec, self.parameters, device, seed=seed)
        if spec.needs_torch:
            keep_freed_memory()

    def layers(self, names: Sequence[str]) -> list[Tensor]:
        """Weight and bias of each layer, one after another, in the form that `MLPNode` expects."""
        return [self.parameters[f"{name}.{kind}"] for name in names for kind in ("weight", "bias")]

    def mlp(self, x: Tensor, layers: Sequence[Tensor]) -> Tensor:
        """Apply these layers to x, with the activation after each but the last, which is linear."""
        out: Tensor = MLPNode.apply(x, self._relu, *layers)  # type: ignore[no-untyped-call]
        return out

    def hidden(self, x: Tensor, layers: Sequence[Tensor]) -> Tensor:
        """Apply these layers to x, with the activation after each."""
        if not layers:
            return x
        out = self.mlp(x, layers)
        return torch.relu(out) if self._relu else torch.tanh(out)


class ActorCriticNetwork(FlatNetwork):
    """An actor and a critic, with separate or shared hidden layers. An encoder and a recurrent core are always shared."""

    def __init__(self, spec: PolicySpec, device: str | torch.device = "cpu", *, seed: int = 0) -> None:
        super().__init__(spec, device, seed=seed)
        trunk = hidden_names(spec)
        self._acting_features = feature_size(spec)
        self._trunk = self.layers(trunk) if spec.shared_net else []
        self._actor = self.layers(["actor.out"] if spec.shared_net else [*trunk, "actor.out"])
        self._critic = self.layers(["critic.out"] if spec.shared_net else [*hidden_names(spec, "critic"), "critic.out"])

    def _params(self, h: Tensor) -> Tensor:
        out = self.mlp(h, self._actor)
        log_std = self.parameters.get("actor.log_std")
        return out if log_std is None else torch.cat([out, log_std.expand(len(out), -1)], -1)

    def _common(self, x: Tensor, images: Sequence[Tensor], recurrent: RecurrentInput | None) -> Tensor:
        return self.hidden(self.encode(x[:, : self._acting_features], images, recurrent), self._trunk)

    def _value(self, h: Tensor, x: Tensor, recurrent: RecurrentInput | None) -> Tensor:
        """V [B] for the actor's input `h` and the features in `x` that only the critic sees."""
        if self.spec.critic:
            more = x[:, self._acting_features :]
            rows = None if recurrent is None else recurrent.output_rows
            h = torch.cat((h, more if rows is None else more[rows]), -1)
        return self.mlp(h, self._critic)[:, 0]

    def forward(
        self, x: Tensor, images: Sequence[Tensor] = (), recurrent: RecurrentInput | None = None
    ) -> tuple[Tensor, Tensor]:
        """Features [B, D] float32 and images [B, *leaf] uint8 -> distribution params [B, P], value [B].

        In x, the D features are followed by those that only the critic sees, if any. With a recurrent core, x and images are
        [T · C, …], and `recurrent` says where episodes begin and which B rows to return.
        """
        h = self._common(x, images, recurrent)
        return self._params(h), self._value(h, x, recurrent)

    def params(self, x: Tensor, images: Sequence[Tensor] = (), recurrent: RecurrentInput | None = None) -> Tensor:
        """Only the distribution params [B, P] of `forward`."""
        return self._params(self._common(x, images, recurrent))

    def value(self, x: Tensor, images: Sequence[Tensor] = (), recurrent: RecurrentInput | None = None) -> Tensor:
        """Only the value [B] of `forward`."""
        return self._value(self._common(x, images, recurrent), x, recurrent)

    def evaluate(
        self,
        x: Tensor,
        images: Sequence[Tensor],
        recurrent: RecurrentInput | None,
        action: Tensor,
        mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Log π(action), the entropy of π, and V, [B] each.

        `mask` [B, choices] says which choices are allowed. The probability and the gradient of a choice that is not allowed
        are exactly 0. For the other arguments, see `forward`.
        """
        params, value = self.forward(x, images, recurrent)
        if mask is not None:
            others = params.shape[-1] - mask.shape[-1]  # params of bits and numbers, which follow those of choices
            params = params.masked_fill(F.pad(~mask, (0, others)), FORBIDDEN)
        return *log_prob_and_entropy(self.spec.action, params, action), value


class QNetwork(FlatNetwork):
    """The value of every action, with or without the dueling architecture (Wang et al. 2016)."""

    def __init__(self, spec: PolicySpec, device: str | torch.device = "cpu", *, seed: int = 0) -> None:
        super().__init__(spec, device, seed=seed)
        self._without_dueling = self.layers([*hidden_names(spec), "q.out"])
        self._hidden = self.layers(hidden_names(spec))

    def params(self, x: Tensor, images: Sequence[Tensor] = ()) -> Tensor:
        """Action values [B, n] for features [B, D] float32 and images [B, *leaf] uint8."""
        return self.head(self.encode(x, images))

    def head(self, h: Tensor) -> Tensor:
        """Action values [B, n] for the encoder's outputs h [B, H]."""
        if not self.spec.dueling:
            return self.mlp(h, self._without_dueling)
        h = self.hidden(h, self._hidden)
        return self.action_values(self.mlp(h, self.layers(["q.out"])), self.mlp(h, self.layers(["q.value"])))

    def acting_parameters(self) -> Floats:
        """A copy of the parameters [P] with which workers act, that is, of all parameters."""
        return self.flat.cpu().numpy().copy()

    @staticmethod
    def action_values(advantage: Tensor, value: Tensor | None = None) -> Tensor:
        """The action values [B, n] from the network's outputs. With the dueling architecture, Q = V + A − mean A."""
        return advantage if value is None else value + advantage - advantage.mean(-1, keepdim=True)


class ActorAndCritics(FlatNetwork):
    """An actor whose actions are in [-1, 1], and two critics, which map an observation and an action to a value.

    `actor` and `critics` are two parts of the flat tensor. Each has its part of the gradients, and its own optimizer. The
    encoder, if there is one, is trained with the critics, and the actor uses its output (Yarats et al. 2022). Therefore, the
    methods that compute losses take the encoder's outputs h [B, H], which are the features if there is no encoder.
    """

    def __init__(self, spec: PolicySpec, device: str | torch.device = "cpu", *, seed: int = 0) -> None:
        super().__init__(spec, device, seed=seed)
        end = self.acting_size - total_size(encoder_layout(spec)[0])
        self.actor = self.flat[:end]
        """[A] float32, in the memory of `flat`: the actor without the encoder"""
        self.actor.grad = self.flat_grad[:end]
        self.critics = self.flat[end:]
        """[E + C] float32, in the memory of `flat`: the encoder, then the critics"""
        self.critics.grad = self.flat_grad[end:]
        self._actor = self.layers([*hidden_names(spec), "actor.out"])
        self._constant_critics = self.flat[self.acting_size :]
        self._critics = trainable(self._constant_critics, self.flat_grad[self.acting_size :])

    def acting_parameters(self) -> Floats:
        """A copy of the parameters with which workers act: those of the actor, then those of the encoder."""
        return self.flat[: self.acting_size].cpu().numpy().copy()

    def _stacked(self, critics: int, flat: Tensor) -> list[Tensor]:
        """Weight [critics, out, in] and bias [critics, out] of each layer of the first `critics` critics: views of `flat`
        [C].
        """
        each = flat.view(len(CRITICS), -1)[:critics]
        views = []
        at = 0
        for field in self.fields:
            if field.name.startswith(f"{CRITICS[0]}."):
                end = at + math.prod(field.shape)
                views.append(each[:, at:end].view(critics, *field.shape))
                at = end
        return views

    def params(self, x: Tensor, images: Sequence[Tensor] = ()) -> Tensor:
        """Like `actor_params`, for features [B, D] float32 and images [B, *leaf] uint8."""
        return self.actor_params(self.encode(x, images))

    def actor_params(self, h: Tensor) -> Tensor:
        """The actor's output before the hyperbolic tangent: [B, D′] if it is deterministic, else [B, 2 D′].

        For a squashed Gaussian, the second half is the logarithm of the standard deviations, clipped to [-20, 2].
        """
        out = self.mlp(h, self._actor)
        if self.spec.head == "deterministic":
            return out
        mean, log_std = out.chunk(2, -1)
        return torch.cat((mean, log_std.clamp(*LOG_STD_BOUNDS)), -1)

    def sample(self, h: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [B, D′] of a squashed Gaussian, and their log-densities [B], for standard normal noise [B, D′]."""
        return squashed_sample(self.actor_params(h), noise)

    def values(self, h: Tensor, action: Tensor, *, constant: bool = False, critics: int = len(CRITICS)) -> Tensor:
        """The values [critics, B] that both critics, or only the first, give to actions [B, D′] in [-1, 1].

        With `constant`, gradients flow to the actions but not to the critics. Use it for the actor's loss.
        """
        flat = self._constant_critics if constant else self._critics
        layers = partial(self._stacked, critics)
        out: Tensor = StackedMLPNode.apply(torch.cat((h, action), -1), self._relu, flat, layers)  # type: ignore[no-untyped-call]
        return out[..., 0]


def initial_fields(fields: Sequence[Field], generator: torch.Generator) -> Tensor:
    """Initial parameters [P]: each field is orthogonal with its gain, or zeros if the gain is 0."""
    parts = [torch.zeros(0, dtype=DTYPE)]
    for field in fields:
        part = torch.zeros(field.shape, dtype=DTYPE)
        if field.gain:
            torch.nn.init.orthogonal_(part, field.gain, generator)
        parts.append(part.flatten())
    return torch.cat(parts)
