"""DQN (Mnih et al. 2015), with double, dueling, n-step and prioritized variants.

An update adds a batch to the replay buffer and takes a fixed number of gradient steps, so the settings, not speed, determine
how often a transition is used. ε falls with the number of env steps in all batches so far, and is published with the
weights. The settings are in `learner/config/hyperparameters.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar

import numpy as np
import torch
from msgspec.structs import replace
from torch import Tensor

from millrace.learner.algorithms import losses
from millrace.learner.algorithms.gradient_descent import UpdateMetrics, clip_norm
from millrace.learner.algorithms.kernels.optimizer_step import make_optimizer, take_step
from millrace.learner.algorithms.kernels.trained_networks import ActionValueNetwork, q_network
from millrace.learner.algorithms.replay.off_policy import CriticLoss, OffPolicy
from millrace.learner.algorithms.replay.replay_buffer import Sample
from millrace.learner.algorithms.replay.sequence_replay import SequenceSample
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import DQNConfig, QLearningConfig
from millrace.protocol.arrays import Floats
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.masks import FORBIDDEN
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

LOSSES = {"huber": losses.huber_loss, "squared": losses.squared_loss}


def exploration_rate(config: QLearningConfig, env_steps: int) -> float:
    """ε after `env_steps` env steps, summed over all env copies."""
    start = config.epsilon_start
    end = config.epsilon_end
    done = env_steps / config.epsilon_steps
    return end + (start - end) * (max(0.0, 1 - done) if config.epsilon_schedule == "linear" else math.exp(-done))


class DQN(OffPolicy):
    """The Q-network with its target network and its optimizer, and the replay buffer with the prior data."""

    Config: ClassVar[type[QLearningConfig]] = DQNConfig
    net: ActionValueNetwork
    target: ActionValueNetwork

    @classmethod
    def policy_spec(cls, config: QLearningConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """Action values for any supported observation. Raises `UsageError` unless the action space is Discrete."""
        if action.kind != "discrete":
            name = cls.__name__.lower()
            others = "ppo, sac or xqc" if action.kind == "box" and action.unbounded is None else "ppo"
            raise UsageError(
                f"{name}: expected an action space Discrete(n), got {action.in_words}; take --algo {others} for it"
            )
        return replace(OffPolicy.policy_spec(config, observation, action), head="q", dueling=config.dueling)

    def __init__(
        self, config: QLearningConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        super().__init__(config, policy, total_steps=total_steps, seed=seed)
        self.net, self.target = (self.network(device, seed) for _ in range(2))
        self.tensors = {"parameters": self.net.flat, "target": self.target.flat}
        optimizer = make_optimizer(config.optimizer, self.net.flat, amsgrad=config.amsgrad)
        self.optimizers = {"optimizer": optimizer}

    def network(self, device: str, seed: int) -> ActionValueNetwork:
        """Create a network of action values. Called for the network and for its target, which begin with equal weights."""
        return q_network(self.policy, device, seed)

    def steps_due(self) -> int:
        """The number of gradient steps in this update, which is constant once learning has started."""
        return self.config.gradient_steps if self.env_steps >= self.config.learning_starts else 0

    def transitions(self, sample: Sample | SequenceSample) -> Transitions:
        """See `OffPolicy`. `x`, `next_x` and `target_x` are already encoded, so losses need neither images nor sequences."""
        rows = super().transitions(sample)
        if not self.policy.has_encoder_layers:
            return rows
        return rows.encoded(self.net.encode)._replace(target_x=rows.encoded_next(self.target.encode))

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """See `OffPolicy.update`. The metrics include ε."""
        metrics = super().update(batch, pulse)
        return {"rollout/exploration_rate": exploration_rate(self.config, self.env_steps)} | metrics

    @torch.no_grad()
    def targets(self, rows: Transitions) -> Tensor:
        """The targets [B] of the action values: y = Σ γⁱ r + γᵏ Q′(s′, a′).

        a′ = argmax Q′(s′, ·), or argmax Q(s′, ·) if double (van Hasselt et al. 2016). Q′ is the target network. With action
        masks, a′ is the best of the actions that are allowed in s′.
        """
        values = self.target.head(rows.target_x)
        chooses = self.net.head(rows.next_x) if self.config.double else values
        return rows.reward + rows.discount * values.gather(1, best_action(chooses, rows.next_mask)[:, None])[:, 0]

    def loss(self, rows: Transitions) -> CriticLoss:
        """E[w ℓ(Q(s, a) − y)], where ℓ is the Huber loss or the square."""
        values = self.net.head(rows.x).gather(1, rows.action[:, None])[:, 0]
        error = values - self.targets(rows)
        return CriticLoss(LOSSES[self.config.loss](error, rows.weight), error, {"q_mean": values.mean()})

    def step(self, rows: Transitions) -> tuple[UpdateMetrics, Tensor]:
        """Take one gradient step on a minibatch, then update the target network if an update of it is due."""
        critic = self.loss(rows)
        optimizer = self.optimizers["optimizer"]
        metrics = self.differentiate(critic.loss, optimizer, {**critic.numbers, "loss": critic.loss})
        self._clip_gradient(metrics["grad_norm"])
        take_step(optimizer)
        self.gradient_steps += 1
        self._update_target()
        return metrics, critic.error

    def _clip_gradient(self, norm: float) -> None:
        config = self.config
        gradient = self.net.flat_grad
        if config.max_grad_value is not None:
            gradient.clamp_(-config.max_grad_value, config.max_grad_value)
            norm = gradient.norm().item() if config.max_grad_norm is not None else norm
        if config.max_grad_norm is not None:
            clip_norm(self.net.flat, norm, config.max_grad_norm)

    def _update_target(self) -> None:
        """Move the target network after every `target_every`-th gradient step."""
        if self.gradient_steps % self.config.target_every == 0:
            self.target.flat.lerp_(self.net.flat, self.config.tau)

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the Q-network's parameters [P], and of the buffers: the observation statistics, then ε."""
        epsilon = np.float32(exploration_rate(self.config, self.env_steps))
        return self.net.acting_parameters(), np.append(self.statistics, epsilon)


def best_action(values: Tensor, mask: Tensor | None) -> Tensor:
    """The actions [B] with the highest of the values [B, n], among those that the mask [B, n] allows."""
    return (values if mask is None else values.masked_fill(~mask, FORBIDDEN)).argmax(1)
