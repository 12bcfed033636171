"""PPO (Schulman et al. 2017). Its settings: `learner.config.hyperparameters`. No sockets, no files, no clock; seeded.

One update uses a batch for `n_epochs` epochs of minibatches. Rows that are not valid never enter one. With one torch
thread on a CPU the same batches give the same bits, also after `load_state_dict`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import torch

from learner.algorithms import actor_critic, losses
from learner.algorithms.actor_critic import Minibatch, Parts
from learner.algorithms.kernels.optimizer_step import take_step
from learner.algorithms.returns import gae
from learner.config.hyperparameters import PPOConfig
from protocol.arrays import Floats
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec


class Measured(NamedTuple):
    """What one minibatch measured, before it moved the weights."""

    policy_gradient_loss: float
    value_loss: float
    entropy_loss: float
    approx_kl: float
    clip_fraction: float
    grad_norm: float  # before it was clipped


class PPO:
    """The policy, its optimiser and their schedules."""

    whole_episodes = False

    @staticmethod
    def policy_spec(config: PPOConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """An actor and a critic, on any of the supported spaces."""
        return actor_critic.policy_spec(config, observation, action)

    def __init__(self, config: PPOConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        self.config = config
        self.policy = policy
        self.parts = Parts(config, policy, "adam", total_steps=total_steps, seed=seed, device=device)
        self.net = self.parts.net
        self.epochs = 0  # epochs made: what Stable-Baselines3 calls n_updates
        self._kl_limit = math.inf if config.target_kl is None else 1.5 * config.target_kl

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Learn from a batch, calling `pulse` between minibatches; gives the metrics, by Stable-Baselines3's names.

        Raises `RunError` when a loss or a gradient is not finite, before it reaches the weights.
        """
        if not batch.valid.any():
            return {}
        config, parts = self.config, self.parts
        parts.set_learning_rate()
        clip_range = config.clip_range * (parts.left() if config.clip_range_schedule == "linear" else 1)
        seen = parts.see(batch)
        values, ends = parts.values(seen, pulse), (batch.terminated, batch.truncated, batch.valid)
        advantage = gae(parts.rewards(batch), values, *ends, config.gamma, config.gae_lambda)
        target = advantage + values[:-1]
        rows = parts.rows(batch, seen, advantage, target)
        number = math.ceil(np.count_nonzero(batch.valid) / config.batch_size)
        epochs: list[list[Measured]] = []
        for minibatches in islice(parts.epochs(rows, batch.valid, number), config.n_epochs):
            epochs.append(self._epoch(minibatches, clip_range, pulse))
            if self._too_far(epochs):
                break
        parts.used(batch, seen)
        self.epochs += len(epochs)
        return self._metrics(epochs) | {
            "train/explained_variance": losses.explained_variance(values[:-1][batch.valid], target[batch.valid]),
            "train/clip_range": clip_range,
        }

    def _epoch(self, minibatches: Iterable[Minibatch], clip_range: float, pulse: Callable[[], None]) -> list[Measured]:
        """Use each valid row once, in minibatches of nearly equal size."""
        found: list[Measured] = []
        for minibatch in minibatches:
            found.append(self.step(minibatch, clip_range))
            pulse()
            if self._too_far([found]):
                break
        return found

    def _too_far(self, epochs: list[list[Measured]]) -> bool:
        return bool(epochs) and epochs[-1][-1].approx_kl > self._kl_limit

    @np.errstate(all="ignore")  # what is not finite is found and named
    def step(self, rows: Minibatch, clip_range: float) -> Measured:
        """One step of Adam on a minibatch of valid rows; none if the policy moved too far already."""
        config = self.config
        log_prob, entropy, value = self.parts.forward(rows)
        with torch.no_grad():
            advantage = losses.standardized(rows.advantage) if config.normalize_advantage else rows.advantage
            log_ratio, ratio = losses.ratio(log_prob, rows.log_prob)
            policy_loss, by_log_prob = losses.clipped_surrogate(ratio, advantage, clip_range)
            if config.clip_range_vf is None:
                value_loss, by_value = losses.value_loss(value, rows.target)
            else:
                before = rows.target - rows.advantage
                value_loss, by_value = losses.clipped_value_loss(value, rows.target, before, config.clip_range_vf)
            entropy_loss, by_entropy = losses.entropy_loss(entropy)
            by_entropy *= config.ent_coef
            by_value *= config.vf_coef
            numbers = {
                "policy_gradient_loss": policy_loss,
                "value_loss": value_loss,
                "entropy_loss": entropy_loss,
                "approx_kl": losses.approx_kl(log_ratio, ratio),
                "clip_fraction": losses.clip_fraction(ratio, clip_range),
            }
        outputs, gradients = (log_prob, entropy, value), (by_log_prob, by_entropy, by_value)
        measured = Measured(**self.parts.backward(outputs, gradients, numbers))
        if measured.approx_kl <= self._kl_limit:
            take_step(self.parts.optimizer)
        return measured

    def _metrics(self, epochs: list[list[Measured]]) -> dict[str, float]:
        metrics = self.parts.metrics([measured._asdict() for epoch in epochs for measured in epoch])
        last = epochs[-1][-1]
        weighted = self.config.ent_coef * last.entropy_loss + self.config.vf_coef * last.value_loss
        return metrics | {
            "train/loss": last.policy_gradient_loss + weighted,
            "train/approx_kl": float(np.mean([measured.approx_kl for measured in epochs[-1]])),
            "train/n_updates": float(self.epochs),
        }

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the buffers, as `protocol.policy.layout` lays them out."""
        return self.parts.weights()

    def state_dict(self) -> dict[str, Any]:
        """A copy of all that the next update depends on: tensors and plain data (`torch.load(weights_only=True)`)."""
        return self.parts.state_dict() | {"epochs": self.epochs}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there: the next update is the one that would have followed, bit for bit."""
        self.parts.load_state_dict(state)
        self.epochs = state["epochs"]
