"""TD3 (Fujimoto et al. 2018): a deterministic actor, two critics, smoothed targets. `Continuous` has what SAC shares.

target     y = Σ γⁱ r + γᵏ min Q′(s′, a′),  a′ = clip(μ′(s′) + clip(noise), ±1);  γᵏ is 0 if the task has terminated
critics    Σ mean (Q(s, a) − y)²
actor      −mean Q₀(s, μ(s)),  once for every `policy_delay` steps of the critics; the target networks move then
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from learner.algorithms.continuous import Continuous, Transitions
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

    def step(self, sample: Sample) -> StepMetrics:
        """One gradient step of the critics, and perhaps one of the actor and the targets."""
        net, rows = self.net, Transitions(self, sample)
        values = net.values(rows.x, rows.action)
        error = values - self.targets(rows, self.noise(*rows.action.shape))
        critic_loss = (rows.weight * error.square()).mean(1).sum()
        net.differentiate_critics(critic_loss)
        found = {"critic_loss": critic_loss.item(), "critic_grad_norm": net.critics.grad.norm().item()}  # type: ignore[union-attr]
        check_finite(found, self.version, ADVICE)
        take_step(self.optimizers["critic_optimizer"])
        self.gradient_steps += 1
        actor_loss = self._step_of_actor(rows) if self.gradient_steps % self.config.policy_delay == 0 else np.nan
        self.replay.update_priorities(sample.slots, error.detach().abs().mean(0).cpu().numpy())
        return StepMetrics(found["critic_loss"], actor_loss, values.detach().mean().item())

    def _step_of_actor(self, rows: Transitions) -> float:
        """A gradient step of the actor; then both targets move. Returns the loss."""
        net = self.net
        loss = -net.values(rows.x, torch.tanh(net.params(rows.x)), constant=True)[0].mean()
        net.differentiate_actor(loss)
        found: dict[str, float] = {"actor_loss": loss.item(), "actor_grad_norm": net.actor.grad.norm().item()}  # type: ignore[union-attr]
        check_finite(found, self.version, ADVICE)
        take_step(self.optimizers["actor_optimizer"])
        self.target.flat.lerp_(net.flat, self.config.tau)
        return found["actor_loss"]

    def targets(self, rows: Transitions, noise: Tensor) -> Tensor:
        """The targets [B] of both critics; `noise` [B, D′] is normal."""
        config = self.config
        with torch.no_grad():
            smooth = (noise * config.target_noise).clamp(-config.target_noise_clip, config.target_noise_clip)
            action = (torch.tanh(self.target.params(rows.next_x)) + smooth).clamp(-1, 1)
            return rows.reward + rows.discount * self.target.values(rows.next_x, action).amin(0)
