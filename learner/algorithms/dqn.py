"""DQN (Mnih et al. 2015), with double, dueling, n-step and prioritized variants. Settings: `learner.config.hyperparameters`.

An update adds a batch to the replay buffer and makes a fixed number of gradient steps, so how often a transition is used is
a setting and does not depend on speed. ε falls with the number of env steps used and is published with the weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from learner.algorithms.kernels import loss_gradients
from learner.algorithms.kernels.action_values import action_values
from learner.algorithms.kernels.optimizer_step import avoid_compiler_import, take_step
from learner.algorithms.replay.mixed_replay import MixedReplay
from learner.algorithms.replay.off_policy import OffPolicy
from learner.algorithms.replay.replay_buffer import Sample
from learner.algorithms.updates import check_finite
from learner.config.hyperparameters import DQNConfig
from protocol.arrays import Floats
from protocol.errors import UsageError
from protocol.policy.networks import QNetwork
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec


class StepMetrics(NamedTuple):
    """The metrics of one gradient step, measured before it changed the weights."""

    loss: float
    q_mean: float  # mean over the actions that were taken
    grad_norm: float  # before clipping


ADVICE = "a lower learning_rate, or normalize_observations"
LOSSES = {"huber": loss_gradients.huber_loss, "squared": loss_gradients.squared_loss}


def exploration_rate(config: DQNConfig, env_steps: int) -> float:
    """ε after `env_steps` env steps, summed over all env copies."""
    start, end, done = config.epsilon_start, config.epsilon_end, env_steps / config.epsilon_steps
    return end + (start - end) * (max(0.0, 1 - done) if config.epsilon_schedule == "linear" else math.exp(-done))


class DQN(OffPolicy):
    """The Q-network, the target network, their optimizer, and the replay buffer with the prior data."""

    replay: MixedReplay

    Config = DQNConfig

    @staticmethod
    def policy_spec(config: DQNConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """Action values for any supported observation. Raises `UsageError` unless the action space is Discrete."""
        if action.kind != "discrete":
            shape = list(action.shape)
            raise UsageError(f"dqn: expected an action space Discrete(n), got {action.kind}{shape}; take --algo ppo for it")
        return PolicySpec(
            observation,
            action,
            net=config.net,
            activation=config.activation,
            normalize_observations=config.normalize_observations,
            head="q",
            dueling=config.dueling,
        )

    def __init__(self, config: DQNConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        super().__init__(config, policy, total_steps=total_steps, seed=seed, device=device)
        self.net = QNetwork(policy, device, seed=seed)
        self.target = QNetwork(policy, device, seed=seed)
        self._values, self._target_values = (action_values(net, config.batch_size) for net in (self.net, self.target))
        avoid_compiler_import()
        optimizer = torch.optim.Adam if config.optimizer == "adam" else torch.optim.AdamW
        self._optimizer = optimizer([self.net.flat], lr=config.learning_rate, amsgrad=config.amsgrad, fused=True)
        self.tensors = {"parameters": self.net.flat, "target": self.target.flat}
        self.optimizers = {"optimizer": self._optimizer}

    def steps_due(self) -> int:
        """The same number of gradient steps in each update, once learning has started."""
        return self.config.gradient_steps if self.env_steps >= self.config.learning_starts else 0

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """See `OffPolicy.update`; the metrics also have ε."""
        metrics = super().update(batch, pulse)
        return {"rollout/exploration_rate": exploration_rate(self.config, self.env_steps)} | metrics

    @np.errstate(all="ignore")  # `check_finite` finds and names what is not finite
    def step(self, sample: Sample) -> StepMetrics:
        """One gradient step on a minibatch; then the target network and the priorities are updated."""
        values, target = self._values, self.targets(sample)
        chosen = values.chosen(*self.inputs(sample.leaves), values.to_array(sample.action))
        error = chosen - target
        loss, by_chosen = LOSSES[self.config.loss](error, values.to_array(sample.weight))
        values.backward(by_chosen)
        measured = StepMetrics(*values.numbers_and_norm(loss, chosen.sum() / len(chosen)))
        check_finite(measured._asdict(), self.version, ADVICE)
        self._clip_gradient(measured.grad_norm)
        take_step(self._optimizer)
        self.gradient_steps += 1
        self._update_target()
        self.replay.update_priorities(sample.slots, error if isinstance(error, np.ndarray) else error.cpu().numpy())
        return measured

    def targets(self, sample: Sample) -> Any:
        """The targets [B] of the action values:  Σ γⁱ r + γᵏ Q′(s′, a′). γᵏ is 0 if the task has terminated.

        a′ = argmax Q′(s′, ·), or argmax Q(s′, ·) if double (van Hasselt et al. 2016). Q′ is the target network. With action
        masks, a′ is the best of the actions that are allowed in s′.
        """
        inputs, values, mask = self.inputs(sample.next_leaves), self._target_values, sample.next_mask
        if self.config.double:
            with torch.no_grad():
                value = values.chosen(*inputs, self._values.best_actions(*inputs, mask))
        else:
            value = values.best_values(*inputs, mask)
        return values.to_array(sample.reward) + values.to_array(sample.discount) * value

    def _clip_gradient(self, norm: float) -> None:
        config, gradient = self.config, self.net.flat_grad
        if config.max_grad_value is not None:
            gradient.clamp_(-config.max_grad_value, config.max_grad_value)
            norm = gradient.norm().item() if config.max_grad_norm is not None else norm
        if config.max_grad_norm is not None and norm > config.max_grad_norm:
            gradient.mul_(config.max_grad_norm / norm)

    def _update_target(self) -> None:
        """Update the target network after a gradient step."""
        if self.config.target == "polyak":
            self.target.flat.lerp_(self.net.flat, self.config.tau)
        elif self.gradient_steps % self.config.target_every == 0:
            self.target.flat.copy_(self.net.flat)

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the Q-network's parameters [P] and of the buffers: the observation statistics, then ε."""
        epsilon = np.float32(exploration_rate(self.config, self.env_steps))
        return self.net.flat.cpu().numpy().copy(), np.append(self.statistics, epsilon)
