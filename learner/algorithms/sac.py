"""SAC (Haarnoja et al. 2018): a squashed Gaussian policy, two critics, and an automatic temperature.

A call to `step` takes one gradient step of the critics, then one of the actor, then one of the temperature; then it moves
the target critics. `OffPolicy.update` calls `step` for each step that is due. `Continuous` has the parts that SAC and TD3
share.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from millrace.learner.algorithms.algorithm import Start
from millrace.learner.algorithms.bodies.autograd_leaves import trainable
from millrace.learner.algorithms.gradient_descent import UpdateMetrics
from millrace.learner.algorithms.kernels.optimizer_step import make_optimizer
from millrace.learner.algorithms.replay.continuous import Continuous
from millrace.learner.algorithms.replay.off_policy import CriticLoss
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import SACConfig
from millrace.protocol.errors import UsageError
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec


class SAC(Continuous):
    """An actor, two critics with their target networks, and the temperature."""

    Config = SACConfig

    @staticmethod
    def policy_spec(config: SACConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """A squashed Gaussian. Raises `UsageError` unless the action is a bounded Box."""
        return SAC.bounded_policy_spec(config, observation, action, head="squashed")

    def __init__(self, config: SACConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        super().__init__(config, policy, total_steps=total_steps, seed=seed, device=device)
        self.log_temperature = torch.full((1,), math.log(1.0 if config.ent_coef is None else config.ent_coef), device=device)
        if config.ent_coef is None:
            self.log_temperature.grad = torch.zeros_like(self.log_temperature)
            self.tensors["log_temperature"] = self.log_temperature
            self.optimizers["ent_coef_optimizer"] = make_optimizer("adam", self.log_temperature)
        self.target_entropy = -math.prod(policy.action.shape) if config.target_entropy is None else config.target_entropy

    @property
    def batch_normalization(self) -> str:
        """Where the actor has batch normalization. If two actors differ in this, neither can use the other's parameters."""
        return "none"

    @property
    def temperature(self) -> float:
        """The temperature α, named `ent_coef` in the settings and the metrics, as in Stable-Baselines3."""
        return math.exp(self.log_temperature.item())

    def sample(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Actions ã ~ π(s) [B, D′] for features [B, D], and log π(ã|s) [B]."""
        return self.net.sample(x, self.noise(len(x)))

    @torch.no_grad()
    def targets(self, rows: Transitions) -> Tensor:
        """The targets [B] of both critics: y = Σ γⁱ r + γᵏ (min Q′(s′, a′) − α log π(a′|s′)),  a′ ~ π(s′)."""
        action, log_prob = self.sample(rows.next_x)
        value = self.target.values(rows.next_x, action).amin(0)
        return rows.reward + rows.discount * (value - self.temperature * log_prob)

    def critic_loss(self, rows: Transitions) -> CriticLoss:
        """½ Σ E[w (Q(s, a) − y)²] over both critics."""
        values = self.net.values(rows.x, rows.action)  # [2, B]
        error = values - self.targets(rows)
        loss = 0.5 * (rows.weight * error.square()).mean(1).sum()
        return CriticLoss(loss, error.detach().abs().mean(0), {"q_mean": values.mean()})

    def actor_loss(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """E[α log π(ã|s) − min Q(s, ã)],  ã ~ π(s), for features [B, D]. Also returns log π(ã|s) [B]."""
        action, log_prob = self.sample(x)
        value = self.net.values(x, action, constant=True).amin(0)  # constant critics: only the actor gets a gradient
        return (self.temperature * log_prob - value).mean(), log_prob.detach()

    def temperature_loss(self, log_temperature: Tensor, log_prob: Tensor) -> Tensor:
        """−E[log α (log π(ã|s) + target entropy)]."""
        return -(log_temperature * (log_prob + self.target_entropy)).mean()

    def start_from(self, start: Start) -> None:
        """See `Algorithm.start_from`. If the earlier run did not learn its temperature, the new run keeps its own.

        Raises `UsageError` if the earlier run's actor has batch normalization in other places.
        """
        expected, got = self.batch_normalization, start.state.get("batch_normalization", "none")
        if expected != got:
            raise UsageError(
                f"start_from: batch normalization of its actor: expected {expected} as in this run, got {got}; "
                "take a run of the same algorithm"
            )
        anew = {"log_temperature": self.log_temperature, "ent_coef_optimizer": {"state": {}}}
        super().start_from(start._replace(state=anew | start.state))

    def step(self, rows: Transitions) -> tuple[UpdateMetrics, Tensor]:
        """Take one gradient step of the critics, the actor and the temperature; then move the target critics."""
        critic = self.critic_loss(rows)
        measured = {"ent_coef": self.temperature} | self.descend("critic", critic.loss, critic.numbers)

        loss, log_prob = self.actor_loss(rows.x.detach())
        measured |= self.descend("actor", loss, {"entropy": -log_prob.mean()})

        if self.config.ent_coef is None:
            loss = self.temperature_loss(trainable(self.log_temperature, self.log_temperature.grad), log_prob)
            measured |= self.descend("ent_coef", loss, {})

        self.target.critics.lerp_(self.net.critics, self.config.tau)
        self.gradient_steps += 1
        return measured, critic.error
