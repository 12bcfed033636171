"""What SAC and TD3 share: an actor with two critics, uniform actions at first, and an exact replay ratio.

Rule: after each update, the gradient steps made are ⌊updates_per_step × (env steps used − learning_starts)⌋, whatever the
size of the rollouts and the number and speed of the workers. Where these settings change, the count goes on from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from learner.algorithms.algorithm import Start
from learner.algorithms.cloning.clones import Clones
from learner.algorithms.cloning.demonstrations import Demonstrations
from learner.algorithms.kernels.actor_and_critics import passes_of
from learner.algorithms.kernels.optimizer_step import avoid_compiler_import
from learner.algorithms.replay.off_policy import OffPolicy
from learner.algorithms.replay.replay_buffer import Sample
from learner.config.hyperparameters import ContinuousConfig
from protocol.errors import UsageError
from protocol.policy.networks import ActorAndCritics
from protocol.policy.torch_distributions import policy_log_prob
from protocol.random_streams import Purpose, torch_seed
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec


class Transitions:
    """The arrays of B transitions, of the kind that the passes of the algorithm's networks use. Actions are in [-1, 1]."""

    def __init__(self, algorithm: Continuous, sample: Sample) -> None:
        array = algorithm.passes.to_array
        self.x, self.next_x = (array(algorithm.inputs(leaves)[0]) for leaves in (sample.leaves, sample.next_leaves))
        """[B, D] features of the observations, and of those k steps later"""
        self.action = array(sample.action.reshape(len(sample.action), -1))
        """[B, D′]"""
        self.reward, self.discount, self.weight = map(array, (sample.reward, sample.discount, sample.weight))
        """[B] each: Σ γⁱ r; γᵏ, or 0 if the task has terminated; weight of the loss"""


class Continuous(Clones, OffPolicy):
    """An off-policy algorithm for a bounded Box: the networks, their targets, their optimizers and the source of noise."""

    Config = ContinuousConfig
    config: Any

    @classmethod
    def bounded_policy_spec(
        cls, config: ContinuousConfig, observation: tuple[Leaf, ...], action: ActionSpec, **head: Any
    ) -> PolicySpec:
        """The policy of these spaces. `head`: fields of `PolicySpec`.

        Raises `UsageError`, with a one-line message, unless the action is a Box with finite bounds and no image is observed.
        """
        name = cls.__name__.lower()
        if action.kind != "box":
            shape = list(action.shape)
            raise UsageError(
                f"{name}: expected an action space Box, got {action.kind}{shape}; take --algo ppo or dqn for it"
            )
        for low, high in zip(action.low, action.high, strict=True):
            if not (math.isfinite(low) and math.isfinite(high)):
                raise UsageError(f"{name}: expected an action Box with finite bounds, got {low} to {high}; take --algo ppo")
        if images := [leaf for leaf in observation if leaf.is_image]:
            where = f" at {images[0].path}" if images[0].path else ""
            raise UsageError(f"{name}: expected no images, got {list(images[0].shape)}{where}; take --algo ppo for them")
        if config.encoder is not None:
            raise UsageError(f"{name}: expected no encoder, got {config.encoder}; take --algo ppo for it")
        return PolicySpec(
            observation,
            action,
            net=config.net,
            activation=config.activation,
            normalize_observations=config.normalize_observations,
            **head,
        )

    def __init__(
        self, config: ContinuousConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        super().__init__(config, policy, total_steps=total_steps, seed=seed, device=device)
        self.net = ActorAndCritics(policy, device, seed=seed)
        self.target = ActorAndCritics(policy, device, seed=seed)
        self.passes, self.target_passes = (passes_of(net, config.batch_size) for net in (self.net, self.target))
        self._generator = torch.Generator().manual_seed(torch_seed(seed, Purpose.NOISE))
        self._counted = {"updates_per_step": config.updates_per_step, "env_steps": config.learning_starts, "made": 0}
        self._learning_starts = config.learning_starts
        self._acts_at_once = False  # with a policy that is not from nothing, no uniform actions come first
        self.tensors = {"parameters": self.net.flat, "target": self.target.flat}
        self.optimizers = {name: adam(part, config) for name, part in self.parts().items()}
        self.optimizer, self.seed = self.optimizers["actor_optimizer"], seed

    def parts(self) -> dict[str, Tensor]:
        """The flat tensors that an optimizer each changes, by the optimizer's name."""
        return {"actor_optimizer": self.net.actor, "critic_optimizer": self.net.critics}

    def clone(self, episodes: Iterable[Batch], pulse: Callable[[], None]) -> dict[str, float]:
        """See `Clones`: the actor alone. It acts from the first env step."""
        found = super().clone(episodes, pulse)
        self.target.actor.copy_(self.net.actor)
        self._acts_at_once = True
        return found

    def cloning_loss(self, rows: Demonstrations) -> tuple[Tensor, Tensor]:
        """See `Clones`."""
        x, _ = self.inputs(rows.obs(rows.at))
        observed, action = (torch.from_numpy(array).to(self.net.flat.device) for array in (x, rows.action))
        params = self.net.params(observed)
        return -policy_log_prob(self.policy, params, action).mean(), params

    def steps_due(self) -> int:
        """The gradient steps that the replay ratio demands now."""
        ratio = Fraction(repr(self.config.updates_per_step))  # as it is written: 0.29 × 100 is 29
        steps = math.floor(ratio * max(0, self.env_steps - self._counted["env_steps"]))
        return max(0, int(self._counted["made"]) + steps - (self.gradient_steps - self.prior_gradient_steps))

    def noise(self, *shape: int) -> Any:
        """Normal noise [*shape], of the kind of array that the passes use."""
        return self.passes.to_array(torch.randn(*shape, generator=self._generator).numpy())

    def weights(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Copies of the actor's parameters [P], and of the buffers: observation statistics, and what exploration needs."""
        warm_up = float(self.env_steps < self.config.learning_starts and not self._acts_at_once)
        exploration = np.array([*self.exploration(), warm_up], np.float32)
        return self.net.actor.cpu().numpy().copy(), np.concatenate((self.statistics, exploration))

    def exploration(self) -> list[float]:
        """What the buffers of the policy hold between the statistics and the number that says whether it warms up."""
        return []

    def numbers(self) -> dict[str, Any]:
        """See `OffPolicy.numbers`."""
        counted = self._counted | {"learning_starts": self._learning_starts}
        more = {"counted": counted, "noise": self._generator.get_state(), "acts_at_once": self._acts_at_once}
        return super().numbers() | more | {"clone_steps": self.clone_steps}

    def start_from(self, start: Start) -> None:
        """See `Algorithm.start_from`. The policy acts from the first env step."""
        super().start_from(start)
        self._acts_at_once = True

    def load_numbers(self, state: dict[str, Any]) -> None:
        """See `OffPolicy.load_numbers`."""
        super().load_numbers(state)
        self._generator.set_state(state["noise"].clone())
        self._acts_at_once, self.clone_steps = state["acts_at_once"], state["clone_steps"]
        counted, config = dict(state["counted"]), self.config
        self._learning_starts = counted.pop("learning_starts")
        self._counted = counted
        if (counted["updates_per_step"], self._learning_starts) != (config.updates_per_step, config.learning_starts):
            start = max(self.env_steps, config.learning_starts)
            self._learning_starts = config.learning_starts
            self._counted = {
                "updates_per_step": config.updates_per_step, "env_steps": start,
                "made": self.gradient_steps - self.prior_gradient_steps,
            }  # fmt: skip


def adam(flat: Tensor, config: Any) -> torch.optim.Adam:
    """Adam for one flat tensor that has a gradient."""
    avoid_compiler_import()
    return torch.optim.Adam([flat], lr=config.learning_rate, fused=True)
