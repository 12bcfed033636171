"""An algorithm of one's own, by its loss: PPO's clipped objective, and a penalty on the squared log-ratio.

Either `python -m examples.own_loss`, or `millrace train CartPole-v1 --algo examples.own_loss:ClippedPlus --penalty 0.2`.
"""

import torch

import millrace
from millrace.algorithms import ActorCritic, ActorCriticConfig, LossInput


class ClippedPlus(ActorCritic):
    """PPO's clipped objective, and a penalty on the squared log-ratio."""

    class Config(ActorCriticConfig, frozen=True):
        """Settings of ClippedPlus."""

        clip_range: float = 0.2
        """ε of the clipped objective."""
        penalty: float = 0.1
        """Weight of the mean squared log-ratio of new to old action probability."""

    config: Config

    def loss(self, rows: LossInput) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """The loss of a minibatch, and numbers to log. Advantages and targets are made; every row is valid."""
        log_ratio = rows.log_prob_now - rows.log_prob
        ratio, epsilon = log_ratio.exp(), self.config.clip_range
        policy = -torch.minimum(ratio * rows.advantage, ratio.clamp(1 - epsilon, 1 + epsilon) * rows.advantage).mean()
        value, penalty = (rows.value - rows.target).square().mean(), log_ratio.square().mean()
        loss = (
            policy + self.config.penalty * penalty + self.config.vf_coef * value - self.config.ent_coef * rows.entropy.mean()
        )
        return loss, {"policy_loss": policy, "value_loss": value, "penalty": penalty}


if __name__ == "__main__":
    run = millrace.train("CartPole-v1", algo=ClippedPlus, penalty=0.2, learning_rate=1e-3, steps=100_000)
    print(run)
