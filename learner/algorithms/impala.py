"""IMPALA's learner (Espeholt et al. 2018). Its settings are in `learner/config/hyperparameters.py`.

A batch may have been collected with older weights (`max_lag` above 0). V-trace weights each row by the ratio of its action's
probability under the newest policy to its probability under the policy that acted. V-trace is computed in time order, before
rows are shuffled. This module uses no sockets, no files and no clock.
"""

from __future__ import annotations

import numpy as np

from millrace.learner.algorithms.actor_critic import ActorCritic, Estimates, Pulse
from millrace.learner.algorithms.minibatches import Observations, log_probs
from millrace.learner.algorithms.returns import EpisodeEnds, vtrace
from millrace.learner.config.hyperparameters import IMPALAConfig
from millrace.protocol.arrays import Floats
from millrace.protocol.rollout import Batch


class IMPALA(ActorCritic):
    """The policy gradient with V-trace, which is recomputed in each epoch."""

    Config = IMPALAConfig
    config: IMPALAConfig
    estimates_each_epoch = True

    def standardizes_advantages(self) -> bool:
        """See `ActorCritic`."""
        return False

    def minibatch_count(self, rows: int) -> int:
        """See `ActorCritic`."""
        return min(self.config.minibatches, rows)

    def estimate(self, batch: Batch, observations: Observations, reward: Floats, pulse: Pulse) -> Estimates:
        """V-trace advantages and targets under the newest weights.

        The metric `rho` is the mean of the ratios, clipped at 1. It is 1 if all rows were collected with the newest weights.
        """
        config, values = self.config, self.values(observations, pulse)
        log_ratio = log_probs(self.net, observations, batch, pulse) - batch.log_prob
        target, advantage = vtrace(
            reward,
            values,
            log_ratio,
            EpisodeEnds.of(batch),
            config.gamma,
            config.vtrace_lambda,
            config.rho_bar,
            config.c_bar,
        )
        rho = float(np.exp(np.minimum(log_ratio[batch.valid], 0)).mean())
        return Estimates(advantage, target, values, batch.valid, {"rho": rho})
