"""PPO (Schulman et al. 2017). Its settings are in `learner/config/hyperparameters.py`.

An update uses each valid row of a batch once in each of `n_epochs` epochs, in minibatches of at most `batch_size` rows. With
a recurrent core, a minibatch consists of whole columns of the batch, and may have more rows. The update itself is
`ActorCritic.update`; this module adds the loss, the schedule of the clip range, and early stopping. It uses no sockets, no
files and no clock, and all randomness comes from the seed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from millrace.learner.algorithms import losses
from millrace.learner.algorithms.actor_critic import ActorCritic, Estimates
from millrace.learner.algorithms.gradient_descent import UpdateMetrics, scheduled
from millrace.learner.algorithms.minibatches import LossInput
from millrace.learner.config.hyperparameters import PPOConfig
from millrace.protocol.errors import UsageError
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec


class PPO(ActorCritic):
    """The clipped surrogate loss with GAE, for several epochs of minibatches per batch."""

    Config = PPOConfig
    config: PPOConfig

    def __init__(self, config: PPOConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        super().__init__(config, policy, total_steps=total_steps, seed=seed, device=device)
        self.clip_range = config.clip_range  # the value in this update, which follows the schedule
        self.epochs = 0  # epochs made so far, which Stable-Baselines3 calls n_updates
        self._kl_limit = math.inf if config.target_kl is None else 1.5 * config.target_kl

    def set_schedules(self) -> None:
        """Set the learning rate, the entropy coefficient and the clip range of this update."""
        super().set_schedules()
        self.clip_range = scheduled(self.config.clip_range, self.config.clip_range_schedule, self.remaining())

    def stops(self, metrics: UpdateMetrics) -> bool:
        """Whether the KL divergence from the policy that acted is more than 1.5 times `target_kl`."""
        if math.isinf(self._kl_limit):
            return False
        if "approx_kl" not in metrics:
            raise UsageError(
                f"{type(self).__name__}.loss: target_kl needs approx_kl among the numbers that it logs, got "
                f"{', '.join(metrics)}; log losses.approx_kl(…), or set target_kl to none"
            )
        return metrics["approx_kl"] > self._kl_limit

    def loss(self, rows: LossInput) -> tuple[Tensor, Mapping[str, Tensor | float]]:
        """L = −E[min(ρ A, clip(ρ, 1−ε, 1+ε) A)] + vf_coef · E[(V − G)²] − ent_coef · E[H(π)],  ρ = π(a) / π_old(a).

        See Schulman et al. 2017, equations 7 and 9. If `clip_range_vf` is set, the value loss is clipped, and V_old is
        computed as G − A. If you override `estimate`, therefore keep G = A + V.
        """
        config = self.config
        log_ratio = rows.log_prob_now - rows.log_prob
        policy_loss = losses.clipped_surrogate(log_ratio, rows.advantage, self.clip_range)
        if config.clip_range_vf is None:
            value_loss = losses.value_loss(rows.value, rows.target)
        else:
            old_value = rows.target - rows.raw_advantage
            value_loss = losses.clipped_value_loss(rows.value, rows.target, old_value, config.clip_range_vf)
        entropy_loss = losses.entropy_loss(rows.entropy)
        return policy_loss + config.vf_coef * value_loss + self.ent_coef * entropy_loss, {
            "policy_gradient_loss": policy_loss,
            "value_loss": value_loss,
            "entropy_loss": entropy_loss,
            "approx_kl": losses.approx_kl(log_ratio),
            "clip_fraction": losses.clip_fraction(log_ratio, self.clip_range),
        }

    def metrics(self, epochs: Sequence[Sequence[UpdateMetrics]], estimates: Sequence[Estimates]) -> UpdateMetrics:
        """The metrics, with the last loss, the last epoch's KL divergence, the clip range, and the number of epochs so far.

        If a subclass has its own loss, the KL divergence is included only if this loss logs it.
        """
        metrics = super().metrics(epochs, estimates)
        metrics |= {"train/n_updates": float(self.epochs), "train/clip_range": self.clip_range}
        if epochs[-1]:  # empty if `estimate` left no row to use
            metrics["train/loss"] = epochs[-1][-1]["loss"]
        if divergences := [step["approx_kl"] for step in epochs[-1] if "approx_kl" in step]:
            metrics["train/approx_kl"] = float(np.mean(divergences))
        return metrics

    def count_update(self, batch: Batch, epochs: int) -> None:
        """See `ActorCritic`."""
        super().count_update(batch, epochs)
        self.epochs += epochs

    def other_state(self) -> dict[str, Any]:
        """See `GradientDescent`."""
        return super().other_state() | {"epochs": self.epochs}

    def load_other_state(self, state: dict[str, Any]) -> None:
        """See `GradientDescent`."""
        super().load_other_state(state)
        self.epochs = int(state["epochs"])
