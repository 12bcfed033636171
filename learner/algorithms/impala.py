"""IMPALA's learner (Espeholt et al. 2018). Its settings: `learner.config.hyperparameters`. No sockets, no files, no clock.

A batch may have been acted on under older weights (`max_lag` above 0): V-trace weighs each row by how likely the newest
policy, whose log-probabilities are computed here, is to act so. It is computed in time order, before any shuffle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from learner.algorithms import actor_critic, losses
from learner.algorithms.actor_critic import Minibatch, Parts, Seen
from learner.algorithms.returns import vtrace
from learner.config.hyperparameters import ImpalaConfig
from protocol.arrays import Floats
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec


class Impala:
    """The policy, its optimiser and their schedules."""

    whole_episodes = False

    @staticmethod
    def policy_spec(config: ImpalaConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """An actor and a critic, on any of the supported spaces."""
        return actor_critic.policy_spec(config, observation, action)

    def __init__(
        self, config: ImpalaConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        self.config = config
        self.policy = policy
        self.parts = Parts(config, policy, config.optimizer, total_steps=total_steps, seed=seed, device=device)
        self.net = self.parts.net

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Learn from a batch, calling `pulse` between minibatches; gives the metrics, by Stable-Baselines3's names.

        Raises `RunError` when a loss or a gradient is not finite, before it reaches the weights.
        """
        if not batch.valid.any():
            return {}
        parts = self.parts
        parts.set_learning_rate()
        seen, reward = parts.see(batch), parts.rewards(batch)
        measured: list[dict[str, float]] = []
        for _ in range(self.config.n_epochs):
            rows, told = self._rows(batch, seen, reward, pulse)
            for minibatch in parts.minibatches(rows, batch.valid, min(self.config.minibatches, batch.env_steps)):
                measured.append(parts.policy_gradient_step(minibatch) | told)
                pulse()
        parts.used(batch, seen)
        return parts.metrics(measured)

    def _rows(
        self, batch: Batch, seen: Seen, reward: Floats, pulse: Callable[[], None]
    ) -> tuple[Minibatch, dict[str, float]]:
        """All rows, with advantages and targets by V-trace under the newest weights; and what it was like."""
        config, parts = self.config, self.parts
        values, log_ratio = parts.values(seen, pulse), parts.log_probs(seen, batch, pulse) - batch.log_prob
        ends = (batch.terminated, batch.truncated, batch.valid)
        clipped = (config.vtrace_lambda, config.rho_bar, config.c_bar)
        target, advantage = vtrace(reward, values, log_ratio, *ends, config.gamma, *clipped)
        told = {
            "explained_variance": losses.explained_variance(values[:-1][batch.valid], target[batch.valid]),
            "rho": float(np.exp(np.minimum(log_ratio[batch.valid], 0)).mean()),  # 1: as the worker's policy
        }
        return parts.rows(batch, seen, advantage, target), told

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the buffers, as `protocol.policy.layout` lays them out."""
        return self.parts.weights()

    def state_dict(self) -> dict[str, Any]:
        """A copy of all that the next update depends on: tensors and plain data (`torch.load(weights_only=True)`)."""
        return self.parts.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there: the next update is the one that would have followed, bit for bit."""
        self.parts.load_state_dict(state)
