"""Custom losses: PPO with a penalty on the squared log-ratio, and SAC with CQL's conservative term.

Run `python -m examples.own_loss`, or `millrace train CartPole-v1 --algo examples.own_loss:ClippedPlus --penalty 0.2`.
"""

from typing import Any

import torch

import millrace
from millrace.algorithms import PPO, SAC, CriticLoss, LossInput, PPOConfig, SACConfig, Transitions


class ClippedPlus(PPO):
    """PPO with a penalty on the squared log-ratio."""

    class Config(PPOConfig, frozen=True):
        """The settings of ClippedPlus."""

        penalty: float = 0.1
        """Weight of the mean squared log-ratio of new to old action probability."""

    config: Config

    def loss(self, rows: LossInput) -> tuple[torch.Tensor, dict[str, torch.Tensor | float]]:
        """PPO's loss plus the penalty."""
        loss, numbers = super().loss(rows)
        penalty = (rows.log_prob_now - rows.log_prob).square().mean()
        return loss + self.config.penalty * penalty, {**numbers, "penalty": penalty}


class Conservative(SAC):
    """SAC with a penalty on the values of actions that are not in the data: L + Σ E[Q(s, ã) − Q(s, a)],  ã ~ π(s)."""

    class Config(SACConfig, frozen=True):
        """The settings of Conservative."""

        conservative: float = 1.0
        """Weight of the conservative term (Kumar et al. 2020, equation 2)."""

    config: Config

    def critic_loss(self, rows: Transitions) -> CriticLoss:
        """SAC's loss plus the conservative term, for which the critics are called again."""
        found = super().critic_loss(rows)
        with torch.no_grad():
            action, _ = self.sample(rows.x)
        excess = (self.net.values(rows.x, action) - self.net.values(rows.x, rows.action)).mean(1).sum()
        loss = found.loss + self.config.conservative * excess
        return found._replace(loss=loss, numbers={**found.numbers, "excess": excess})


if __name__ == "__main__":
    own: dict[str, Any] = {"penalty": 0.2}  # so that type checkers, which know only millrace's settings, don't complain
    print(millrace.train("CartPole-v1", algo=ClippedPlus, learning_rate=1e-3, steps=100_000, **own))
