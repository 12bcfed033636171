"""The networks that the learner trains. On the CPU, a small network computes in numpy, as one node of autograd's graph.

Rule: whether numpy or torch computes a pass depends only on the network's shape and device. Both give the same numbers,
except for rounding, so a loss need not know which one is used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.autograd_leaves import trainable
from millrace.learner.algorithms.bodies.networks import ActorAndCritics, ActorCriticNetwork, QNetwork
from millrace.learner.algorithms.kernels.distribution_kernels import EvaluatedActions, SquashedSample, distribution_kernel
from millrace.learner.algorithms.kernels.mlp import SmallMLP, Trunks, Values
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.policy.encoder import Encoder, RecurrentInput
from millrace.protocol.policy.features import feature_size
from millrace.protocol.policy.layout import CRITICS, hidden_names
from millrace.protocol.specs import PolicySpec

MAX_UNITS = 256  # units per layer; with more units, matrix products take nearly all the time (`benchmarks.update`)


def is_small(spec: PolicySpec, device: str) -> bool:
    """Whether the network is a plain MLP without large layers, on the CPU."""
    if device != "cpu" or spec.has_encoder_layers or spec.critic:
        return False
    return max((feature_size(spec), *spec.net)) <= MAX_UNITS


def actor_critic_network(spec: PolicySpec, device: str, seed: int) -> ActorCriticNetwork:
    """Create the network of an actor and a critic: the small kind if it is small enough."""
    return (SmallActorCritic if is_small(spec, device) else ActorCriticNetwork)(spec, device, seed=seed)


class ActionValueNetwork(Protocol):
    """A network of action values, such as `QNetwork`."""

    flat: Tensor
    """[P] all parameters"""
    flat_grad: Tensor
    """[P] their gradient"""

    @property
    def encode(self) -> Encoder:
        """The module that computes h [B, H] from features [B, D] and images [B, *leaf] uint8."""
        ...

    def head(self, h: Tensor) -> Tensor:
        """Action values [B, n] for the encoder's outputs h [B, H]."""
        ...

    def acting_parameters(self) -> Floats:
        """A copy of the parameters [P′] that workers act with."""
        ...


def q_network(spec: PolicySpec, device: str, seed: int) -> QNetwork:
    """Create the network of action values: the small kind if it is small enough."""
    return (SmallQNetwork if is_small(spec, device) else QNetwork)(spec, device, seed=seed)


def actor_and_critics(spec: PolicySpec, device: str, seed: int) -> ActorAndCritics:
    """Create the networks of an actor and two critics: the small kind if they are small enough."""
    small = is_small(spec, device) and len(spec.net) > 0  # the derivative with respect to the action needs a hidden layer
    return (SmallActorAndCritics if small else ActorAndCritics)(spec, device, seed=seed)


class SmallActorCritic(ActorCriticNetwork):
    """A small actor and critic. One pass computes both, and then the action distribution."""

    def __init__(self, spec: PolicySpec, device: str = "cpu", *, seed: int = 0) -> None:
        super().__init__(spec, device, seed=seed)
        leaf = trainable(self.flat, self.flat_grad)
        relu = spec.activation == "relu"
        actor = hidden_names(spec)
        trunks = [actor] if spec.shared_net else [actor, hidden_names(spec, "critic")]

        def evaluation(values: Mapping[str, Array], gradients: Mapping[str, Array]) -> EvaluatedActions:
            return EvaluatedActions(
                distribution_kernel(spec.action, values.get("actor.log_std"), gradients.get("actor.log_std"))
            )

        critic = ("critic.out", len(trunks) - 1)
        value = ("critic.out", 0)
        self._both = SmallMLP(leaf, self.fields, Trunks(trunks, [("actor.out", 0), critic]), relu, evaluation)
        self._critic_alone = SmallMLP(leaf, self.fields, Trunks(trunks[-1:], [value]), relu, lambda *_: Values())

    def evaluate(
        self,
        x: Tensor,
        images: Sequence[Tensor],
        recurrent: RecurrentInput | None,
        action: Tensor,
        mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `ActorCriticNetwork`."""
        log_prob, entropy, value = self._both(x, action, mask)
        return log_prob, entropy, value

    def value(self, x: Tensor, images: Sequence[Tensor] = (), recurrent: RecurrentInput | None = None) -> Tensor:
        """See `ActorCriticNetwork`."""
        return self._critic_alone(x)[0][0]


class SmallQNetwork(QNetwork):
    """A small network of action values."""

    def __init__(self, spec: PolicySpec, device: str = "cpu", *, seed: int = 0) -> None:
        super().__init__(spec, device, seed=seed)
        names = ("q.out", "q.value") if spec.dueling else ("q.out",)
        trunks = Trunks([hidden_names(spec)], [(name, 0) for name in names])
        self._small = SmallMLP(trainable(self.flat, self.flat_grad), self.fields, trunks, spec.activation == "relu")

    def head(self, h: Tensor) -> Tensor:
        """See `QNetwork`."""
        return self.action_values(*self._small(h))


class SmallActorAndCritics(ActorAndCritics):
    """A small actor and small critics, which have at least one hidden layer."""

    def __init__(self, spec: PolicySpec, device: str = "cpu", *, seed: int = 0) -> None:
        super().__init__(spec, device, seed=seed)
        relu = spec.activation == "relu"
        acting = self.fields[: self.acting_fields]
        actor = Trunks([hidden_names(spec)], [("actor.out", 0)])
        leaf = trainable(self.actor, self.actor.grad)
        self._sample = SmallMLP(leaf, acting, actor, relu, lambda *_: SquashedSample())
        self._output = SmallMLP(leaf, acting, actor, relu)
        leaf = trainable(self.critics, self.critics.grad)
        fields = self.fields[self.acting_fields :]

        def critics(names: Sequence[str]) -> SmallMLP:
            outputs = [(f"{name}.out", i) for i, name in enumerate(names)]
            return SmallMLP(
                leaf, fields, Trunks([hidden_names(spec, name) for name in names], outputs), relu, lambda *_: Values()
            )

        self._values = {count: critics(CRITICS[:count]) for count in range(1, len(CRITICS) + 1)}

    def sample(self, h: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """See `ActorAndCritics`."""
        action, log_prob = self._sample(h, noise)
        return action, log_prob

    def actor_params(self, h: Tensor) -> Tensor:
        """See `ActorAndCritics`."""
        return self._output(h)[0] if self.spec.head == "deterministic" else super().actor_params(h)

    def values(self, h: Tensor, action: Tensor, *, constant: bool = False, critics: int = len(CRITICS)) -> Tensor:
        """See `ActorAndCritics`."""
        return self._values[critics](torch.cat((h, action), -1), constant=constant)[0]
