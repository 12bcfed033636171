"""TD3 (Fujimoto et al. 2018): a deterministic actor, two critics, smoothed targets. `Continuous` has what SAC shares.

target     y = Σ γⁱ r + γᵏ min Q′(s′, a′),  a′ = clip(μ′(s′) + clip(noise), ±1);  γᵏ is 0 if the task has terminated
critics    Σ mean (Q(s, a) − y)²
actor      −mean Q₀(s, μ(s)),  once for every `policy_delay` steps of the critics; the target networks move then
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch.linalg import vector_norm

from learner.algorithms.continuous import Continuous, Transitions
from learner.algorithms.kernels.bounded_actions import DeterministicAction, smaller
from learner.algorithms.kernels.optimizer_step import take_step
from learner.algorithms.replay.replay_buffer import Sample
from learner.algorithms.updates import check_finite
from learner.config.hyperparameters import TD3Config
from protocol.specs import ActionSpec, Leaf, PolicySpec

ADVICE = "a lower learning_rate, or normalize_observations"


class StepMetrics(NamedTuple):
    """The metrics of one gradient step, measured before it changed the weights."""

    critic_loss: float
    actor_loss: float  # NaN where the actor was not changed
    q_mean: float  # mean of both critics over the actions that were taken


class TD3(Continuous):
    """An actor and two critics, with a target for each."""

    Config = TD3Config

    @staticmethod
    def policy_spec(config: TD3Config, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """A deterministic actor. Raises `UsageError` unless the action is a bounded Box and no image is observed."""
        return TD3.bounded_policy_spec(config, observation, action, head="deterministic")

    def exploration(self) -> list[float]:
        """The scale of the noise that workers add."""
        return [self.config.exploration_noise]

    @np.errstate(all="ignore")  # `check_finite` finds and names what is not finite
    def step(self, sample: Sample) -> StepMetrics:
        """One gradient step of the critics, and perhaps one of the actor and the targets."""
        rows, count = Transitions(self, sample), len(sample.slots)
        values = self.passes.values(rows.x, rows.action)
        error = values - self.targets(rows, self.noise(*rows.action.shape))
        weighted = rows.weight * error
        self.passes.critics_backward(weighted * (2 / count))
        critic_loss, q_mean = float((weighted * error).sum()) / count, float(values.sum()) / (2 * count)
        found = {"critic_loss": critic_loss, "critic_grad_norm": vector_norm(self.net.critics.grad).item()}
        check_finite(found, self.version, ADVICE)
        take_step(self.optimizers["critic_optimizer"])
        self.gradient_steps += 1
        actor_loss = self._step_of_actor(rows) if self.gradient_steps % self.config.policy_delay == 0 else np.nan
        if self.replay.prioritized:
            self.replay.update_priorities(sample.slots, self.passes.to_numpy(abs(error).mean(0)))
        return StepMetrics(critic_loss, actor_loss, q_mean)

    def _step_of_actor(self, rows: Transitions) -> float:
        """A gradient step of the actor; then both targets move. Returns the loss."""
        chosen = DeterministicAction(self.passes.params(rows.x))
        values = self.passes.values_by_action(rows.x, chosen.action, 1)
        by_values = 0 * values - 1 / len(chosen.action)
        self.passes.actor_backward(chosen.backward(self.passes.action_gradient(by_values)))
        loss = float(-values.mean())
        found = {"actor_loss": loss, "actor_grad_norm": vector_norm(self.net.actor.grad).item()}
        check_finite(found, self.version, ADVICE)
        take_step(self.optimizers["actor_optimizer"])
        self.target.flat.lerp_(self.net.flat, self.config.tau)
        return loss

    def targets(self, rows: Transitions, noise: Any) -> Any:
        """The targets [B] of both critics; `noise` [B, D′] is normal."""
        config = self.config
        with torch.no_grad():
            smooth = (noise * config.target_noise).clip(-config.target_noise_clip, config.target_noise_clip)
            action = (DeterministicAction(self.target_passes.params(rows.next_x)).action + smooth).clip(-1, 1)
            value = smaller(self.target_passes.values(rows.next_x, action))
            return rows.reward + rows.discount * value
