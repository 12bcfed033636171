"""REINFORCE (Williams 1992). Its settings are in `learner/config/hyperparameters.py`.

An update is one gradient step on the rows whose episode ends within the rollout, because all rewards that follow these rows
are known. Other rows are dropped, and their number is logged. The return of a truncated episode includes the baseline's
value for its final observation; without a baseline, the return ends with the last reward. This module uses no sockets, no
files and no clock.
"""

from __future__ import annotations

import numpy as np

from millrace.learner.algorithms.actor_critic import ActorCritic, Estimates, Pulse
from millrace.learner.algorithms.minibatches import Observations
from millrace.learner.algorithms.returns import EpisodeEnds, complete, gae
from millrace.learner.config.hyperparameters import REINFORCEConfig
from millrace.protocol.arrays import Floats
from millrace.protocol.rollout import Batch


class REINFORCE(ActorCritic):
    """The policy gradient with the Monte Carlo returns of complete episodes."""

    Config = REINFORCEConfig
    config: REINFORCEConfig
    whole_episodes = True

    @property
    def n_epochs(self) -> int:
        """See `ActorCritic`."""
        return 1

    def minibatch_count(self, rows: int) -> int:
        """See `ActorCritic`."""
        return 1

    @property
    def vf_coef(self) -> float:
        """The weight of the value loss, which is 0 without a baseline."""
        return self.config.vf_coef if self.config.baseline else 0.0

    def standardizes_advantages(self) -> bool:
        """See `ActorCritic`. The only minibatch is the whole batch."""
        return self.config.normalize_returns

    def estimate(self, batch: Batch, observations: Observations, reward: Floats, pulse: Pulse) -> Estimates:
        """The targets are Monte Carlo returns. The advantages are these returns minus the baseline's values."""
        T, N = reward.shape
        values = self.values(observations, pulse) if self.config.baseline else np.zeros((T + 1, N), np.float32)
        ends = EpisodeEnds.of(batch)
        # With λ = 1 an advantage is the return minus the baseline (Sutton and Barto 2018, section 13.4).
        advantage = gae(reward, values, ends, self.config.gamma, 1.0)
        known = complete(ends)
        counts = {
            "rows_used": float(np.count_nonzero(known)),
            "rows_dropped": float(np.count_nonzero(batch.valid & ~known)),
        }
        return Estimates(advantage, advantage + values[:-1], values, known, counts)
