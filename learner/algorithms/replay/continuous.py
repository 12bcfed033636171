"""What SAC and TD3 share: an actor with two critics, uniform actions at first, and an exact replay ratio.

Rule: after each update, the gradient steps made are ⌊updates_per_step × (env steps used − learning_starts)⌋, whatever the
size of the rollouts and the number and speed of the workers. Where these settings change, the count goes on from there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from msgspec.structs import replace
from torch import Tensor

from millrace.learner.algorithms.algorithm import Start
from millrace.learner.algorithms.gradient_descent import UpdateMetrics
from millrace.learner.algorithms.kernels.optimizer_step import make_optimizer, take_step
from millrace.learner.algorithms.kernels.trained_networks import actor_and_critics
from millrace.learner.algorithms.replay.off_policy import OffPolicy
from millrace.learner.algorithms.replay.random_shift import random_shift
from millrace.learner.algorithms.replay.replay_buffer import Sample
from millrace.learner.algorithms.replay.sequence_replay import SequenceSample
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import ContinuousConfig
from millrace.protocol.arrays import Floats
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.encoder import Encoder
from millrace.protocol.random_streams import Purpose, torch_seed
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec


class Networks(Protocol):
    """An actor and critics, such as `ActorAndCritics`: h [B, H] is the encoder's output, actions [B, D′] are in [-1, 1]."""

    flat: Tensor
    """[A + E + C] all parameters, those of the actor first, then the encoder's"""
    actor: Tensor
    """[A] in the memory of `flat`, with a gradient"""
    critics: Tensor
    """[E + C] the encoder and the critics, in the memory of `flat`, with a gradient"""

    @property
    def encode(self) -> Encoder:
        """Makes h of features [B, D] and images [B, *leaf] uint8."""
        ...

    def actor_params(self, h: Tensor) -> Tensor:
        """The actor's output before the tangent, [B, D′] or [B, 2 D′]."""
        ...

    def params(self, x: Tensor, images: Sequence[Tensor] = ()) -> Tensor:
        """The same for features [B, D] and images [B, *leaf] uint8."""
        ...

    def sample(self, h: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions and their log-densities [B], for noise [B, D′]."""
        ...

    def values(self, h: Tensor, action: Tensor, *, constant: bool = False) -> Tensor:
        """Values [critics, B]. `constant`: the critics get no gradient; the actions do."""
        ...

    def acting_parameters(self) -> Floats:
        """A copy of the parameters [P] that workers act with."""
        ...


class Continuous(OffPolicy):
    """An off-policy algorithm for a bounded Box: the networks, their targets, their optimizers and the source of noise."""

    Config = ContinuousConfig
    ADAM: ClassVar[Mapping[str, Any]] = {}
    """Arguments of torch's Adam, for the actor and the critics"""
    net: Networks

    @classmethod
    def bounded_policy_spec(
        cls, config: ContinuousConfig, observation: tuple[Leaf, ...], action: ActionSpec, **head: Any
    ) -> PolicySpec:
        """The policy of these spaces. `head`: fields of `PolicySpec`.

        Raises `UsageError`, with a one-line message, unless the action is a Box with finite bounds.
        """
        name = cls.__name__.lower()
        if action.kind != "box":
            others = "ppo or dqn" if action.kind == "discrete" else "ppo"
            raise UsageError(f"{name}: expected an action space Box, got {action.in_words}; take --algo {others} for it")
        largest = min(float(np.finfo(kind).max) for kind in (action.dtype, "float32"))  # it stands for no bound
        for low, high in zip(action.low, action.high, strict=True):
            if max(-low, high) >= largest:
                raise UsageError(
                    f"{name}: expected an action Box with finite bounds, got {low:g} to {high:g}; "
                    "take --algo ppo, or give the Box the bounds between which good actions are"
                )
        return replace(OffPolicy.policy_spec(config, observation, action), **head)

    def __init__(
        self, config: ContinuousConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        super().__init__(config, policy, total_steps=total_steps, seed=seed)
        self.seed = seed
        self.net = self.networks(device)
        self.target = self.networks(device)
        self._generator = torch.Generator().manual_seed(torch_seed(seed, Purpose.NOISE))
        self._counted = {"updates_per_step": config.updates_per_step, "env_steps": config.learning_starts, "made": 0}
        self._learning_starts = config.learning_starts
        self._acts_at_once = False  # with a policy that is not from nothing, no uniform actions come first
        self.tensors = {"parameters": self.net.flat, "target": self.target.flat}
        trained = {"actor_optimizer": self.net.actor, "critic_optimizer": self.net.critics}
        self.optimizers = {name: make_optimizer("adam", part, **self.ADAM) for name, part in trained.items()}

    def networks(self, device: str) -> Networks:
        """New networks, the same each time: those that are trained, then their targets."""
        return actor_and_critics(self.policy, device, self.seed)

    def after_step(self, name: str) -> None:
        """Called after each step of NAME_optimizer, also in cloning: returns weights to where an algorithm holds them."""

    def begin_with_actor(self) -> None:
        """The actor was trained before the first rollouts: it acts from the first env step, and its target equals it."""
        self.target.actor.copy_(self.net.actor)
        self._acts_at_once = True

    def steps_due(self) -> int:
        """The gradient steps that the replay ratio demands now."""
        ratio = Fraction(repr(self.config.updates_per_step))  # as it is written: 0.29 × 100 is 29
        steps = math.floor(ratio * max(0, self.env_steps - self._counted["env_steps"]))
        return max(0, int(self._counted["made"]) + steps - (self.gradient_steps - self.prior_gradient_steps))

    def noise(self, rows: int) -> Tensor:
        """Normal noise [B, D′]."""
        return torch.randn(rows, math.prod(self.policy.action.shape), generator=self._generator).to(self.net.flat)

    def transitions(self, sample: Sample | SequenceSample) -> Transitions:
        """See `OffPolicy`; an action is a row of numbers, and x and next_x are encoded, so that losses need no images.

        Images are shifted at random first. The loss of the critics trains the encoder through `rows.x`; next_x has no
        gradient (Yarats et al. 2022, DrQ-v2).
        """
        rows = super().transitions(sample)
        rows = rows._replace(action=rows.action.reshape(len(rows.action), -1).to(rows.x))
        if not self.policy.has_encoder_layers:
            return rows
        images = self._shifted(rows.images)
        next_images = images if rows.sequences is not None else self._shifted(rows.next_images)
        return rows._replace(images=images, next_images=next_images).encoded(self.net.encode)

    def _shifted(self, images: Sequence[Tensor]) -> tuple[Tensor, ...]:
        leaves = [leaf for leaf in self.policy.observation if leaf.is_image]
        most = self.config.random_shift
        return tuple(
            random_shift(image, most, channels_last=leaf.has_channels_last, generator=self._generator)
            for image, leaf in zip(images, leaves, strict=True)
        )

    def descend(self, name: str, loss: Tensor, numbers: Mapping[str, Tensor | float]) -> UpdateMetrics:
        """Step the optimizer NAME_optimizer down the gradient of a loss, logged as NAME_loss.

        Sets the gradient to zero, differentiates the loss, raises `RunError` unless the loss, the numbers and the gradient's
        norm are finite, and steps torch's Adam. Gradients are not clipped.
        """
        optimizer = self.optimizers[f"{name}_optimizer"]
        found = self.differentiate(loss, optimizer, {**numbers, f"{name}_loss": loss})
        take_step(optimizer)
        self.after_step(name)
        del found["grad_norm"]
        return found

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the actor's parameters [P], and of the buffers: observation statistics, and what exploration needs."""
        warm_up = float(self.env_steps < self.config.learning_starts and not self._acts_at_once)
        exploration = np.array([*self.exploration(), warm_up], np.float32)
        return self.net.acting_parameters(), np.concatenate((self.statistics, exploration))

    def exploration(self) -> list[float]:
        """What the buffers of the policy hold between the statistics and the number that says whether it warms up."""
        return []

    def other_state(self) -> dict[str, Any]:
        """See `GradientDescent`."""
        counted = self._counted | {"learning_starts": self._learning_starts}
        more = {"counted": counted, "noise": self._generator.get_state(), "acts_at_once": self._acts_at_once}
        return super().other_state() | more

    def start_from(self, start: Start) -> None:
        """See `Algorithm.start_from`. The policy acts from the first env step."""
        super().start_from(start)
        self._acts_at_once = True

    def load_other_state(self, state: dict[str, Any]) -> None:
        """See `GradientDescent`."""
        super().load_other_state(state)
        self._generator.set_state(state["noise"].clone())
        self._acts_at_once = state["acts_at_once"]
        counted = dict(state["counted"])
        config = self.config
        self._learning_starts = counted.pop("learning_starts")
        self._counted = counted
        if (counted["updates_per_step"], self._learning_starts) != (config.updates_per_step, config.learning_starts):
            start = max(self.env_steps, config.learning_starts)
            self._learning_starts = config.learning_starts
            self._counted = {
                "updates_per_step": config.updates_per_step, "env_steps": start,
                "made": self.gradient_steps - self.prior_gradient_steps,
            }  # fmt: skip
