"""TQC (Kuznetsov et al. 2020): SAC whose critics learn quantiles of the return, and whose targets leave out the highest.

SAC uses the lower of two critics' values, so that the actor doesn't exploit the critics' errors. TQC pools the quantiles of
all critics and drops the highest ones, which lets you adjust in finer steps how pessimistic the targets are.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.actor_with_critics import ActorWithCritics, layer_sizes
from millrace.learner.algorithms.bodies.heads import lowest, quantile_huber
from millrace.learner.algorithms.bodies.stacked_mlps import MLPShape
from millrace.learner.algorithms.replay.off_policy import CriticLoss
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.algorithms.sac import SAC
from millrace.learner.config.hyperparameters import TQCConfig
from millrace.protocol.errors import UsageError
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec


class TQC(SAC):
    """An actor, quantile critics with their target networks, and the temperature."""

    Config = TQCConfig
    net: ActorWithCritics
    target: ActorWithCritics

    @staticmethod
    def policy_spec(config: Any, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """A squashed Gaussian. Raises `UsageError` unless the action is a bounded Box and targets keep some quantiles."""
        if config.dropped_quantiles >= config.quantiles:
            raise UsageError(
                f"dropped_quantiles: expected fewer than quantiles, {config.quantiles}, got {config.dropped_quantiles}"
            )
        return TQC.bounded_policy_spec(config, observation, action, head="squashed")

    def networks(self, device: str) -> ActorWithCritics:
        """See `Continuous`."""
        config = self.config
        relu = self.policy.activation == "relu"
        actor, critic = layer_sizes(self.policy, config.net, config.quantiles)
        return ActorWithCritics(
            self.policy,
            MLPShape(1, actor, relu, output_gain=0.01),
            MLPShape(config.critics, critic, relu),
            lambda quantiles: quantiles.mean(-1),
            device,
            self.seed,
        )

    @torch.no_grad()
    def targets(self, rows: Transitions) -> Tensor:
        """The target returns [B, J]: Σ γⁱ r + γᵏ (z − α log π(a′|s′)), for the J lowest quantiles z of all Q′(s′, a′)."""
        config = self.config
        action, log_prob = self.sample(rows.next_x)
        kept = config.critics * (config.quantiles - config.dropped_quantiles)
        z = lowest(self.target.outputs(rows.next_x, action), kept)
        return rows.reward[:, None] + rows.discount[:, None] * (z - self.temperature * log_prob[:, None])

    def critic_loss(self, rows: Transitions) -> CriticLoss:
        """E[w · quantile Huber loss], averaged over the critics."""
        quantiles = self.net.outputs(rows.x, rows.action)  # [K, B, O]
        targets = self.targets(rows)
        loss = (rows.weight * quantile_huber(quantiles, targets)).mean()
        values = quantiles.mean(-1)  # [K, B]
        error = (values - targets.mean(-1)).detach().abs().mean(0)
        return CriticLoss(loss, error, {"q_mean": values.mean()})

    def actor_loss(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """E[α log π(ã|s) − Q(s, ã)],  ã ~ π(s), where Q is the mean of all quantiles. Also returns log π(ã|s) [B]."""
        action, log_prob = self.sample(x)
        value = self.net.values(x, action, constant=True).mean(0)
        return (self.temperature * log_prob - value).mean(), log_prob.detach()
