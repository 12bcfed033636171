"""The base class of CrossQ and XQC: SAC with batch normalization in actor and critics, and fewer steps of the actor.

Rule: observations and next observations, with their actions, pass through the critics in one minibatch. They come from
different distributions, so in separate minibatches they would be normalized by different means, and values and targets
would not be comparable (Bhatt et al. 2024).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from millrace.learner.algorithms.algorithm import Start
from millrace.learner.algorithms.bodies.actor_with_critics import ActorWithCritics
from millrace.learner.algorithms.bodies.autograd_leaves import trainable
from millrace.learner.algorithms.gradient_descent import UpdateMetrics
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.algorithms.sac import SAC
from millrace.learner.config.hyperparameters import NormalizedConfig
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.layout import total_size
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec


class Joint(NamedTuple):
    """The critics' input: observations and next observations in one minibatch."""

    x: Tensor
    """[2 B, D] features of the observations, then of the next observations"""
    action: Tensor
    """[2 B, D′] the actions, then those that the actor would take next"""
    next_log_prob: Tensor
    """[B] log π of the next actions"""


class NormalizedSAC(SAC):
    """SAC with batch normalization in the actor and the critics."""

    net: ActorWithCritics
    target: ActorWithCritics
    config: NormalizedConfig

    @classmethod
    def policy_spec(cls, config: Any, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """A squashed Gaussian. Raises `UsageError` unless the action is a bounded Box."""
        return cls.bounded_policy_spec(config, observation, action, head="squashed")

    def __init__(
        self, config: NormalizedConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        super().__init__(config, policy, total_steps=total_steps, seed=seed, device=device)
        self.tensors["statistics"] = self.net.statistics

    @property
    def batch_normalization(self) -> str:
        """See `SAC`."""
        return self.net.actor_body.shape.normalized.value

    def joint(self, rows: Transitions) -> Joint:
        """The observations and actions of these rows, then the next observations with ã′ ~ π(s′), without a gradient."""
        with torch.no_grad():
            action, log_prob = self.sample(rows.next_x)
        return Joint(torch.cat((rows.x, rows.next_x)), torch.cat((rows.action, action)), log_prob)

    def after_step(self, name: str) -> None:
        """See `Continuous`. Weights that must have norm 1 are scaled back to norm 1."""
        match name:
            case "actor":
                self.net.actor_body.project()
            case "critic":
                self.net.critic_bodies.project()

    def move_target(self) -> None:
        """Move the target critics, if there are any. Called after each step of the critics."""

    def step(self, rows: Transitions) -> tuple[UpdateMetrics, Tensor]:
        """Take one gradient step of the critics and, every `policy_delay`-th time, of the actor and the temperature."""
        critic = self.critic_loss(rows)
        measured = {"ent_coef": self.temperature} | self.descend("critic", critic.loss, critic.numbers)
        self.move_target()
        self.gradient_steps += 1
        if self.gradient_steps % self.config.policy_delay == 0:
            measured |= self.actor_step(rows.x.detach())
        return measured, critic.error

    def actor_step(self, x: Tensor) -> UpdateMetrics:
        """Take one gradient step of the actor, and of the temperature if it is learned, on features [B, D]."""
        loss, log_prob = self.actor_loss(x)
        measured = self.descend("actor", loss, {"entropy": -log_prob.mean()})
        if self.config.ent_coef is None:
            loss = self.temperature_loss(trainable(self.log_temperature, self.log_temperature.grad), log_prob)
            measured |= self.descend("ent_coef", loss, {})
        return measured

    def other_state(self) -> dict[str, Any]:
        """See `GradientDescent`."""
        return super().other_state() | {"batch_normalization": self.batch_normalization}

    def start_from(self, start: Start) -> None:
        """See `Algorithm.start_from`. Raises `UsageError` if the earlier run has no normalization statistics."""
        if "statistics" not in start.state:
            raise UsageError(
                "start_from: expected a run of the same algorithm with a checkpoint, got a policy without the statistics of "
                "batch normalization"
            )
        statistics = total_size(self.net.actor_body.shape.statistics())
        super().start_from(start._replace(acting=self.net.acting_size))
        self.net.statistics[:statistics].copy_(start.state["statistics"][:statistics])
