"""A2C, the synchronous variant of A3C (Mnih et al. 2016). Its settings are in `learner/config/hyperparameters.py`.

An update is one gradient step on all valid rows of a batch. The batch must have been collected with the newest weights. This
module uses no sockets, no files and no clock.
"""

from __future__ import annotations

from millrace.learner.algorithms.actor_critic import ActorCritic
from millrace.learner.config.hyperparameters import A2CConfig


class A2C(ActorCritic):
    """The policy gradient with GAE, and one gradient step per batch."""

    Config = A2CConfig
    config: A2CConfig

    @property
    def n_epochs(self) -> int:
        """See `ActorCritic`."""
        return 1

    def minibatch_count(self, rows: int) -> int:
        """See `ActorCritic`."""
        return 1
