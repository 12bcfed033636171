"""A2C (Mnih et al. 2016, synchronous). Its settings: `learner.config.hyperparameters`. No sockets, no files, no clock.

An update is one gradient step on all valid rows of a batch. The batch must have been collected under the newest weights.
"""

from __future__ import annotations

from learner.algorithms.actor_critic import ActorCritic, Estimates, Pulse
from learner.algorithms.minibatches import Observations
from learner.algorithms.returns import EpisodeEnds, gae
from learner.config.hyperparameters import A2CConfig
from protocol.arrays import Floats
from protocol.rollout import Batch


class A2C(ActorCritic):
    """The policy gradient with GAE, in one step per batch."""

    config: A2CConfig

    def standardizes_advantages(self) -> bool:
        """See `ActorCritic`. The one minibatch is the whole batch."""
        return self.config.normalize_advantage

    def estimate(self, batch: Batch, observations: Observations, reward: Floats, pulse: Pulse) -> Estimates:
        """Generalized advantage estimates A, and the targets A + V."""
        config, values = self.config, self.values(observations, pulse)
        advantage = gae(reward, values, EpisodeEnds.of(batch), config.gamma, config.gae_lambda)
        return Estimates(advantage, advantage + values[:-1], values, batch.valid, {})
