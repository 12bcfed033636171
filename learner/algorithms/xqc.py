"""XQC (Palenicek et al. 2025): SAC with a better-conditioned loss, so it learns more from each step.

XQC changes three parts of SAC. Batch normalization precedes each activation. Weights are kept at norm 1, because an
optimizer step rotates larger weights by smaller angles. Critics predict the probabilities of returns and learn by
cross-entropy, whose gradient is bounded. Rewards are scaled so that values lie within the categories. `NormalizedSAC` has
the parts that XQC and CrossQ share.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.actor_with_critics import ActorWithCritics, layer_sizes
from millrace.learner.algorithms.bodies.heads import Categories
from millrace.learner.algorithms.bodies.normalized_sac import NormalizedSAC
from millrace.learner.algorithms.bodies.stacked_mlps import MLPShape, Normalized
from millrace.learner.algorithms.bounded_returns import BoundedReturns
from millrace.learner.algorithms.replay.off_policy import CriticLoss
from millrace.learner.algorithms.replay.replay_buffer import Sample
from millrace.learner.algorithms.replay.sequence_replay import SequenceSample
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import XQCConfig
from millrace.protocol.specs import PolicySpec

INITIAL_TEMPERATURE = 0.01
"""The initial temperature, in units of scaled rewards."""


class XQC(NormalizedSAC):
    """An actor, two categorical critics with their target networks, and the temperature."""

    Config = XQCConfig
    config: XQCConfig

    def __init__(self, config: XQCConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        self.categories = Categories(config.atoms, config.return_bound, device)
        super().__init__(config, policy, total_steps=total_steps, seed=seed, device=device)
        self.rewards: BoundedReturns = BoundedReturns(config.gamma, config.return_bound)
        if config.ent_coef is None:
            self.log_temperature.fill_(math.log(INITIAL_TEMPERATURE))
        if config.target_entropy is None:
            self.target_entropy = -0.5 * math.prod(policy.action.shape)

    def shapes(self) -> tuple[MLPShape, MLPShape]:
        """The shapes of the actor and of the critics."""
        relu = self.policy.activation == "relu"
        actor, critic = layer_sizes(self.policy, self.config.critic_net, self.config.atoms)
        return (
            MLPShape(1, actor, relu, Normalized.BEFORE, unit_rows=True),
            MLPShape(2, critic, relu, Normalized.BEFORE, unit_rows=True),
        )

    def networks(self, device: str) -> ActorWithCritics:
        """See `Continuous`."""
        return ActorWithCritics(self.policy, *self.shapes(), self.categories.mean, device, self.seed)

    def transitions(self, sample: Sample | SequenceSample) -> Transitions:
        """See `OffPolicy`. Rewards are scaled so that values don't exceed `return_bound`.

        With hindsight, an agent that stays at a goal gets the goal's reward at every step, which no collected return shows.
        """
        if self.config.hindsight and self.config.goal_ends is None:
            self.rewards.may_last(sample.reward, sample.discount)
        return super().transitions(sample)

    def target_distribution(self, rows: Transitions, next_logits: Tensor, next_log_prob: Tensor) -> Tensor:
        """The distribution [B, O] over categories of Σ γⁱ r + γᵏ (Z′ − α log π(a′|s′)), without a gradient.

        Z′ has the distribution that one target critic predicts for s′ and a′: the critic with the lower expected return.
        `next_logits` [2, B, O] are the logits of both target critics.
        """
        pessimist = self.categories.mean(next_logits).argmin(0)
        probabilities = next_logits[pessimist, torch.arange(len(pessimist), device=pessimist.device)].softmax(-1)
        reward = rows.reward - rows.discount * self.temperature * next_log_prob
        return self.categories.shifted(probabilities, reward, rows.discount)

    def cross_entropy(self, rows: Transitions, logits: Tensor, target: Tensor) -> CriticLoss:
        """Σ E[w · cross-entropy] over both critics, for their logits [2, B, O] and a target [B, O]."""
        loss = (rows.weight * self.categories.cross_entropy(logits, target)).mean(1).sum()
        with torch.no_grad():
            values = self.categories.mean(logits)
            error = (values - target @ self.categories.atoms.to(target.dtype)).abs().mean(0)
        # The loss is finite even if a reward is infinite, because a return beyond the bounds counts as the bound. The mean
        # reward is logged so that the check of the logged numbers finds an infinite reward.
        return CriticLoss(loss, error, {"q_mean": values.mean(), "scaled_reward": rows.reward.mean()})

    def critic_loss(self, rows: Transitions) -> CriticLoss:
        """See `cross_entropy` and `target_distribution`.

        The critics, and likewise the target critics, process (s, a) and (s′, a′) together in one minibatch.
        """
        joint = self.joint(rows)
        size = len(rows.x)
        with torch.no_grad():
            next_logits = self.target.minibatch_outputs(joint.x, joint.action)[:, size:]
            target = self.target_distribution(rows, next_logits, joint.next_log_prob)
        return self.cross_entropy(rows, self.net.outputs(joint.x, joint.action)[:, :size], target)

    def move_target(self) -> None:
        """See `NormalizedSAC`. The targets' running statistics are not used."""
        self.target.critics.lerp_(self.net.critics, self.config.tau)
