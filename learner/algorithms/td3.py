"""TD3 (Fujimoto et al. 2018): a deterministic actor, two critics, and smoothed targets.

The actor takes one gradient step for every `policy_delay` steps of the critics; the target networks move when it does.
`OffPolicy.update` calls `step` for each step that is due. `Continuous` has the parts that SAC and TD3 share.
"""

from __future__ import annotations

import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.networks import ActorAndCritics
from millrace.learner.algorithms.gradient_descent import UpdateMetrics
from millrace.learner.algorithms.replay.continuous import Continuous
from millrace.learner.algorithms.replay.off_policy import CriticLoss
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import TD3Config
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec


class TD3(Continuous):
    """An actor and two critics, with a target network for each."""

    Config = TD3Config
    net: ActorAndCritics

    @staticmethod
    def policy_spec(config: TD3Config, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """A deterministic actor. Raises `UsageError` unless the action is a bounded Box."""
        return TD3.bounded_policy_spec(config, observation, action, head="deterministic")

    def exploration(self) -> list[float]:
        """The scale of the noise that workers add to actions."""
        return [self.config.exploration_noise]

    @torch.no_grad()
    def targets(self, rows: Transitions) -> Tensor:
        """The targets [B] of both critics: y = Σ γⁱ r + γᵏ min Q′(s′, a′),  a′ = clip(μ′(s′) + clip(noise), ±1)."""
        largest = self.config.target_noise_clip
        noise = (self.noise(len(rows.x)) * self.config.target_noise).clip(-largest, largest)
        action = (self.target.actor_params(rows.next_x).tanh() + noise).clip(-1, 1)
        return rows.reward + rows.discount * self.target.values(rows.next_x, action).amin(0)

    def critic_loss(self, rows: Transitions) -> CriticLoss:
        """Σ E[w (Q(s, a) − y)²] over both critics."""
        values = self.net.values(rows.x, rows.action)  # [2, B]
        error = values - self.targets(rows)
        loss = (rows.weight * error.square()).mean(1).sum()
        return CriticLoss(loss, error.detach().abs().mean(0), {"q_mean": values.mean()})

    def actor_loss(self, x: Tensor) -> Tensor:
        """−E[Q₀(s, μ(s))], for features [B, D]."""
        value = self.net.values(x, self.net.actor_params(x).tanh(), constant=True, critics=1)  # [1, B]; Q gets no gradient
        return -value.mean()

    def step(self, rows: Transitions) -> tuple[UpdateMetrics, Tensor]:
        """Take one gradient step of the critics. Every `policy_delay`-th time, also step the actor and move the targets."""
        critic = self.critic_loss(rows)
        measured = self.descend("critic", critic.loss, critic.numbers)
        self.gradient_steps += 1
        if self.gradient_steps % self.config.policy_delay == 0:
            measured |= self.descend("actor", self.actor_loss(rows.x.detach()), {})
            self.target.flat.lerp_(self.net.flat, self.config.tau)
        return measured, critic.error
