"""REINFORCE (Williams 1992); its settings stand in `learner.config.hyperparameters`. No sockets, no files, no clock.

One update is one gradient step on the rows whose episode ends within the rollout, and on no other: all the reward that
follows them is known. The other rows are dropped and counted. The return of an episode that the clock ended goes on with
the baseline's value of its final observation; without a baseline there is none, and the return ends there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from learner.algorithms import actor_critic, losses
from learner.algorithms.actor_critic import Parts
from learner.algorithms.returns import complete, gae
from learner.config.hyperparameters import REINFORCEConfig
from protocol.arrays import Floats
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec


class REINFORCE:
    """The policy, its optimiser and their schedules."""

    whole_episodes = True

    @staticmethod
    def policy_spec(config: REINFORCEConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """An actor and a critic, on any of the supported spaces."""
        return actor_critic.policy_spec(config, observation, action)

    def __init__(
        self, config: REINFORCEConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        self.config = config
        self.policy = policy
        self.parts = Parts(config, policy, config.optimizer, total_steps=total_steps, seed=seed, device=device)
        self.net = self.parts.net

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Learn from a batch; gives the metrics, by Stable-Baselines3's names.

        Raises `RunError` when a loss or the gradient is not finite, before it reaches the weights.
        """
        if not batch.valid.any():
            return {}
        config, parts = self.config, self.parts
        parts.set_learning_rate()
        seen, reward = parts.see(batch), parts.rewards(batch)
        values = parts.values(seen, pulse) if config.baseline else np.zeros((len(reward) + 1, *reward.shape[1:]), np.float32)
        # With λ = 1 an advantage is the return less the baseline (Sutton and Barto 2018, section 13.4).
        advantage = gae(reward, values, batch.terminated, batch.truncated, batch.valid, config.gamma, 1.0)
        target = advantage + values[:-1]
        known = complete(batch.terminated | batch.truncated, batch.valid)
        measured = []
        if known.any():
            rows = parts.only(parts.rows(batch, seen, advantage, target), known)
            if config.normalize_returns:
                rows = rows._replace(advantage=losses.standardized(rows.advantage))
            measured.append(parts.policy_gradient_step(rows, critic=config.baseline))
        pulse()
        parts.used(batch, seen)
        explained = losses.explained_variance(values[:-1][known], target[known]) if known.any() else float("nan")
        return parts.metrics(measured) | {
            "train/explained_variance": explained,
            "train/rows_used": float(np.count_nonzero(known)),
            "train/rows_dropped": float(np.count_nonzero(batch.valid & ~known)),
        }

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the buffers, as `protocol.policy.layout` lays them out."""
        return self.parts.weights()

    def state_dict(self) -> dict[str, Any]:
        """A copy of all that the next update depends on: tensors and plain data (`torch.load(weights_only=True)`)."""
        return self.parts.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there: the next update is the one that would have followed, bit for bit."""
        self.parts.load_state_dict(state)
