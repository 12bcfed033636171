"""SAC (Haarnoja et al. 2018): a squashed Gaussian, two critics, automatic temperature. `Continuous` has what TD3 shares.

target         y = Σ γⁱ r + γᵏ (min Q′(s′, a′) − α log π(a′|s′)),  a′ ~ π(s′);  γᵏ is 0 if the task has terminated
critics        ½ Σ mean (Q(s, a) − y)²
actor          mean (α log π(ã|s) − min Q(s, ã)),  ã ~ π(s)
temperature    −log α · mean (log π(ã|s) + target entropy)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from learner.algorithms.continuous import Continuous, Transitions
from learner.algorithms.kernels.optimizer_step import take_step
from learner.algorithms.replay.replay_buffer import Sample
from learner.algorithms.updates import check_finite
from learner.config.hyperparameters import SACConfig
from protocol.policy.torch_distributions import squashed_sample
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
        self.tensors["log_temperature"] = self.log_temperature
        self.target_entropy = -math.prod(policy.action.shape) if config.target_entropy is None else config.target_entropy

    def parts(self) -> dict[str, Tensor]:
        """See `Continuous.parts`; a fixed temperature needs no optimizer."""
        temperature = {"temperature_optimizer": self.log_temperature} if self.config.ent_coef is None else {}
        return super().parts() | temperature

    def step(self, sample: Sample) -> StepMetrics:
        """One gradient step of the critics, the actor and the temperature; then the target critics move."""
        net, rows = self.net, Transitions(self, sample)
        alpha = self.log_temperature.exp()
        next_noise, noise = self.noise(2, *rows.action.shape)

        values = net.values(rows.x, rows.action)
        error = values - self.targets(rows, next_noise, alpha)
        critic_loss = 0.5 * (rows.weight * error.square()).mean(1).sum()
        net.differentiate_critics(critic_loss)
        found = {"critic_loss": critic_loss.item(), "critic_grad_norm": net.critics.grad.norm().item()}  # type: ignore[union-attr]
        check_finite(found, self.version, ADVICE)
        take_step(self.optimizers["critic_optimizer"])

        action, log_prob = squashed_sample(net.params(rows.x), noise)
        actor_loss = (alpha * log_prob - net.values(rows.x, action, constant=True).amin(0)).mean()
        net.differentiate_actor(actor_loss)
        found = {"actor_loss": actor_loss.item(), "actor_grad_norm": net.actor.grad.norm().item()}  # type: ignore[union-attr]
        check_finite(found, self.version, ADVICE)
        take_step(self.optimizers["actor_optimizer"])

        by_log_temperature = -(log_prob.detach().mean() + self.target_entropy)
        ent_coef_loss = (self.log_temperature * by_log_temperature).item()
        if self.config.ent_coef is None:
            self.log_temperature.grad.copy_(by_log_temperature)  # type: ignore[union-attr]
            take_step(self.optimizers["temperature_optimizer"])

        self.target.critics.lerp_(net.critics, self.config.tau)
        self.gradient_steps += 1
        self.replay.update_priorities(sample.slots, error.detach().abs().mean(0).cpu().numpy())
        return StepMetrics(
            critic_loss.item(),
            found["actor_loss"],
            alpha.item(),
            ent_coef_loss if self.config.ent_coef is None else np.nan,
            values.detach().mean().item(),
            -log_prob.detach().mean().item(),
        )

    def targets(self, rows: Transitions, noise: Tensor, alpha: Tensor) -> Tensor:
        """The targets [B] of both critics; `noise` [B, D′] samples the next action."""
        with torch.no_grad():
            action, log_prob = squashed_sample(self.net.params(rows.next_x), noise)
            value = self.target.values(rows.next_x, action).amin(0) - alpha * log_prob
            return rows.reward + rows.discount * value
