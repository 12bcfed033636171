"""A2C (Mnih et al. 2016, synchronous). Its settings: `learner.config.hyperparameters`. No sockets, no files, no clock.

One update is one gradient step on all valid rows of a batch, each once: the batch must be of the weights it moves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from learner.algorithms import actor_critic, losses
from learner.algorithms.actor_critic import Parts
from learner.algorithms.returns import gae
from learner.config.hyperparameters import A2CConfig
from protocol.arrays import Floats
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec


class A2C:
    """The policy, its optimiser and their schedules."""

    whole_episodes = False

    @staticmethod
    def policy_spec(config: A2CConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """An actor and a critic, on any of the supported spaces."""
        return actor_critic.policy_spec(config, observation, action)

    def __init__(self, config: A2CConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
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
        seen = parts.see(batch)
        values, ends = parts.values(seen, pulse), (batch.terminated, batch.truncated, batch.valid)
        advantage = gae(parts.rewards(batch), values, *ends, config.gamma, config.gae_lambda)
        target = advantage + values[:-1]
        rows = parts.only(parts.rows(batch, seen, advantage, target), batch.valid)
        if config.normalize_advantage:
            rows = rows._replace(advantage=losses.standardized(rows.advantage))
        measured = parts.policy_gradient_step(rows)
        pulse()
        parts.used(batch, seen)
        explained = losses.explained_variance(values[:-1][batch.valid], target[batch.valid])
        return parts.metrics([measured]) | {"train/explained_variance": explained}

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the buffers, as `protocol.policy.layout` lays them out."""
        return self.parts.weights()

    def state_dict(self) -> dict[str, Any]:
        """A copy of all that the next update depends on: tensors and plain data (`torch.load(weights_only=True)`)."""
        return self.parts.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there: the next update is the one that would have followed, bit for bit."""
        self.parts.load_state_dict(state)
