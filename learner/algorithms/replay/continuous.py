"""The base class of SAC and TD3: an actor with critics, uniform actions at first, and an exact replay ratio.

Rule: after each update, a total of ⌊updates_per_step × (env steps used − learning_starts)⌋ gradient steps have been taken,
whatever the size of the rollouts and the number and speed of the workers. If a resumed run changes `updates_per_step` or
`learning_starts`, these counts of env steps and gradient steps start anew when the run resumes.
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
    """An actor and critics, such as `ActorAndCritics`.

    h [B, H] is the encoder's output, and actions [B, D′] are in [-1, 1].
    """

    flat: Tensor
    """[A + E + C] all parameters: A of the actor, then E of the encoder, then C of the critics"""
    actor: Tensor
    """[A] the actor's part of `flat`, a view with a gradient"""
    critics: Tensor
    """[E + C] the part of `flat` for the encoder and the critics, a view with a gradient"""

    @property
    def encode(self) -> Encoder:
        """The module that computes h [B, H] from features [B, D] and images [B, *leaf] uint8."""
        ...

    def actor_params(self, h: Tensor) -> Tensor:
        """The actor's output before tanh, [B, D′] or [B, 2 D′]."""
        ...

    def params(self, x: Tensor, images: Sequence[Tensor] = ()) -> Tensor:
        """Like `actor_params`, but for features [B, D] and images [B, *leaf] uint8."""
        ...

    def sample(self, h: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [B, D′] and their log-densities [B], for noise [B, D′]."""
        ...

    def values(self, h: Tensor, action: Tensor, *, constant: bool = False) -> Tensor:
        """Values [critics, B]. If `constant`, the actions get a gradient and the critics don't."""
        ...

    def acting_parameters(self) -> Floats:
        """A copy of the parameters [P] that workers act with."""
        ...


class Continuous(OffPolicy):
    """An off-policy algorithm for a bounded Box: networks and their targets, optimizers, and the source of noise."""

    Config = ContinuousConfig
    ADAM: ClassVar[Mapping[str, Any]] = {}
    """Arguments for torch's Adam, which trains the actor and the critics."""
    net: Networks

    @classmethod
    def bounded_policy_spec(
        cls, config: ContinuousConfig, observation: tuple[Leaf, ...], action: ActionSpec, **head: Any
    ) -> PolicySpec:
        """The policy for these spaces. The keyword arguments `head` are fields of `PolicySpec`.

        Raises `UsageError`, with a one-line message, unless the action space is a Box with finite bounds.
        """
        name = cls.__name__.lower()
        if action.kind != "box":
            others = "ppo, dqn or rainbow" if action.kind == "discrete" else "ppo"
            raise UsageError(f"{name}: expected an action space Box, got {action.in_words}; take --algo {others} for it")
        if action.unbounded is not None:
            low, high = action.unbounded
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
        self._acts_at_once = False  # True if the policy is already trained, so no warm-up of uniform actions is needed
        self.tensors = {"parameters": self.net.flat, "target": self.target.flat}
        trained = {"actor_optimizer": self.net.actor, "critic_optimizer": self.net.critics}
        self.optimizers = {name: make_optimizer("adam", part, **self.ADAM) for name, part in trained.items()}

    def networks(self, device: str) -> Networks:
        """Create networks, the same ones at each call. Called once for the trained networks, and once for their targets."""
        return actor_and_critics(self.policy, device, self.seed)

    def after_step(self, name: str) -> None:
        """Enforce the algorithm's constraints on weights. Called after each step of NAME_optimizer, including in cloning."""

    def begin_with_actor(self) -> None:
        """Act with the actor from the first env step, because it is already trained. Copies the actor to its target."""
        self.target.actor.copy_(self.net.actor)
        self._acts_at_once = True

    def steps_due(self) -> int:
        """The number of gradient steps that the replay ratio demands now."""
        ratio = Fraction(repr(self.config.updates_per_step))  # exact, so that 0.29 × 100 is 29
        steps = math.floor(ratio * max(0, self.env_steps - self._counted["env_steps"]))
        return max(0, int(self._counted["made"]) + steps - (self.gradient_steps - self.prior_gradient_steps))

    def noise(self, rows: int) -> Tensor:
        """Standard normal noise [B, D′], where B is `rows`."""
        return torch.randn(rows, math.prod(self.policy.action.shape), generator=self._generator).to(self.net.flat)

    def transitions(self, sample: Sample | SequenceSample) -> Transitions:
        """See `OffPolicy`. Actions are flattened to [B, D′]; `x` and `next_x` are encoded, so losses need no images.

        Images are shifted at random before they are encoded. The critic loss trains the encoder through `rows.x`; `next_x`
        has no gradient (Yarats et al. 2022, DrQ-v2).
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
        """Step NAME_optimizer down the gradient of a loss. Returns metrics, with the loss as NAME_loss.

        Raises `RunError` before the step unless the loss, the numbers and the gradient's norm are finite. Gradients are not
        clipped.
        """
        optimizer = self.optimizers[f"{name}_optimizer"]
        found = self.differentiate(loss, optimizer, {**numbers, f"{name}_loss": loss})
        take_step(optimizer)
        self.after_step(name)
        del found["grad_norm"]
        return found

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the actor's parameters [P], and of the buffers: observation statistics, then exploration settings."""
        warm_up = float(self.env_steps < self.config.learning_starts and not self._acts_at_once)
        exploration = np.array([*self.exploration(), warm_up], np.float32)
        return self.net.acting_parameters(), np.concatenate((self.statistics, exploration))

    def exploration(self) -> list[float]:
        """The exploration settings, which follow the statistics in the policy's buffers.

        The last number in the buffers is not one of these settings. It says whether to draw uniform actions: it is 1 during
        the warm-up.
        """
        return []

    def other_state(self) -> dict[str, Any]:
        """See `GradientDescent`."""
        counted = self._counted | {"learning_starts": self._learning_starts}
        more = {"counted": counted, "noise": self._generator.get_state(), "acts_at_once": self._acts_at_once}
        return super().other_state() | more

    def start_from(self, start: Start) -> None:
        """See `Algorithm.start_from`. The policy acts from the first env step, without a warm-up of uniform actions."""
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
