"""SAC (Haarnoja et al. 2018): a squashed Gaussian, two critics, automatic temperature. `Continuous` has what TD3 shares.

target         y = Σ γⁱ r + γᵏ (min Q′(s′, a′) − α log π(a′|s′)),  a′ ~ π(s′);  γᵏ is 0 if the task has terminated
critics        ½ Σ mean (Q(s, a) − y)²
actor          mean (α log π(ã|s) − min Q(s, ã)),  ã ~ π(s)
temperature    −log α · mean (log π(ã|s) + target entropy)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.linalg import vector_norm

from learner.algorithms.continuous import Continuous, Transitions
from learner.algorithms.kernels.bounded_actions import SquashedSample, smaller, which_is_smaller
from learner.algorithms.kernels.optimizer_step import take_step
from learner.algorithms.replay.replay_buffer import Sample
from learner.algorithms.updates import check_finite
from learner.config.hyperparameters import SACConfig
from protocol.specs import ActionSpec, Leaf, PolicySpec

ADVICE = "a lower learning_rate, or normalize_observations"


class StepMetrics(NamedTuple):
    """The metrics of one gradient step, measured before it changed the weights."""

    critic_loss: float
    actor_loss: float
    ent_coef: float
    ent_coef_loss: float
    q_mean: float  # mean of both critics over the actions that were taken
    entropy: float


class SAC(Continuous):
    """An actor, two critics with their targets, and the temperature."""

    Config = SACConfig

    @staticmethod
    def policy_spec(config: SACConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """A squashed Gaussian. Raises `UsageError` unless the action is a bounded Box and no image is observed."""
        return SAC.bounded_policy_spec(config, observation, action, head="squashed")

    def __init__(self, config: SACConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        self.log_temperature = torch.full((1,), math.log(1.0 if config.ent_coef is None else config.ent_coef), device=device)
        self.log_temperature.grad = torch.zeros_like(self.log_temperature)
        super().__init__(config, policy, total_steps=total_steps, seed=seed, device=device)
        if config.ent_coef is None:
            self.tensors["log_temperature"] = self.log_temperature
        self.target_entropy = -math.prod(policy.action.shape) if config.target_entropy is None else config.target_entropy

    def parts(self) -> dict[str, Tensor]:
        """See `Continuous.parts`; a fixed temperature needs no optimizer."""
        temperature = {"temperature_optimizer": self.log_temperature} if self.config.ent_coef is None else {}
        return super().parts() | temperature

    @np.errstate(all="ignore")  # `check_finite` finds and names what is not finite
    def step(self, sample: Sample) -> StepMetrics:
        """One gradient step of the critics, the actor and the temperature; then the target critics move."""
        rows, count = Transitions(self, sample), len(sample.slots)
        alpha = math.exp(self.log_temperature.item())
        next_noise, noise = self.noise(2, *rows.action.shape)

        values = self.passes.values(rows.x, rows.action)
        error = values - self.targets(rows, next_noise, alpha)
        weighted = rows.weight * error
        self.passes.critics_backward(weighted / count)
        critic_loss, q_mean = 0.5 * float((weighted * error).sum()) / count, float(values.sum()) / (2 * count)
        found = {"critic_loss": critic_loss, "critic_grad_norm": vector_norm(self.net.critics.grad).item()}
        check_finite(found, self.version, ADVICE)
        take_step(self.optimizers["critic_optimizer"])

        sampled = SquashedSample(self.passes.params(rows.x), noise)
        values = self.passes.values_by_action(rows.x, sampled.action, 2)
        by_action = self.passes.action_gradient(which_is_smaller(values) / -count)
        self.passes.actor_backward(sampled.backward(by_action, alpha / count))
        log_prob = float(sampled.log_prob.sum()) / count
        actor_loss = alpha * log_prob - float(smaller(values).sum()) / count
        found = {"actor_loss": actor_loss, "actor_grad_norm": vector_norm(self.net.actor.grad).item()}
        check_finite(found, self.version, ADVICE)
        take_step(self.optimizers["actor_optimizer"])

        by_log_temperature = -(log_prob + self.target_entropy)
        ent_coef_loss = self.log_temperature.item() * by_log_temperature
        if self.config.ent_coef is None:
            self.log_temperature.grad.fill_(by_log_temperature)  # type: ignore[union-attr]
            take_step(self.optimizers["temperature_optimizer"])
        else:
            ent_coef_loss = np.nan

        self.target.critics.lerp_(self.net.critics, self.config.tau)
        self.gradient_steps += 1
        if self.replay.prioritized:
            self.replay.update_priorities(sample.slots, self.passes.to_numpy(abs(error).mean(0)))
        return StepMetrics(critic_loss, actor_loss, alpha, ent_coef_loss, q_mean, -log_prob)

    def targets(self, rows: Transitions, noise: Any, alpha: float) -> Any:
        """The targets [B] of both critics; `noise` [B, D′] samples the next action."""
        with torch.no_grad():
            sampled = SquashedSample(self.passes.params(rows.next_x), noise)
            value = smaller(self.target_passes.values(rows.next_x, sampled.action))
            return rows.reward + rows.discount * (value - alpha * sampled.log_prob)
