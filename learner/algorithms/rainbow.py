"""Rainbow (Hessel et al. 2018): DQN that learns the quantiles of the return (QR-DQN, Dabney et al. 2018).

Rainbow's other parts are settings of DQN: double, dueling, n-step returns and prioritized replay. Noisy networks are left
out, because workers would have to draw noise for each weight; workers explore with ε instead.

Rule: with batch normalization, observations and next observations pass through the network in one minibatch. They come from
different distributions, so in separate minibatches they would be normalized by different means (Bhatt et al. 2024).
"""

from __future__ import annotations

import torch
from torch import Tensor

from millrace.learner.algorithms.algorithm import Start
from millrace.learner.algorithms.bodies.heads import quantile_huber
from millrace.learner.algorithms.bodies.quantile_q_network import QuantileQNetwork
from millrace.learner.algorithms.bodies.stacked_mlps import Normalized
from millrace.learner.algorithms.dqn import DQN, best_action
from millrace.learner.algorithms.replay.off_policy import CriticLoss, OffPolicy
from millrace.learner.algorithms.replay.replay_buffer import Sample
from millrace.learner.algorithms.replay.sequence_replay import SequenceSample
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import QLearningConfig, RainbowConfig
from millrace.protocol.errors import UsageError
from millrace.protocol.specs import PolicySpec


class Rainbow(DQN):
    """A quantile network with its target network and its optimizer, and the replay buffer with the prior data."""

    Config = RainbowConfig
    net: QuantileQNetwork
    target: QuantileQNetwork

    def __init__(
        self, config: QLearningConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        super().__init__(config, policy, total_steps=total_steps, seed=seed, device=device)
        self.tensors["statistics"] = self.net.statistics

    def network(self, device: str, seed: int) -> QuantileQNetwork:
        """See `DQN`."""
        normalized = Normalized.BEFORE if self.config.batch_norm else Normalized.NOWHERE
        return QuantileQNetwork(self.policy, self.config.quantiles, normalized, device, seed)

    def transitions(self, sample: Sample | SequenceSample) -> Transitions:
        """See `OffPolicy`. Nothing is encoded yet, because observations and next observations are encoded together."""
        return OffPolicy.transitions(self, sample)

    @torch.no_grad()
    def targets(self, rows: Transitions) -> Tensor:
        """The target returns [B, N]: Σ γⁱ r + γᵏ z, for the N quantiles z of Q′(s′, a′), where a′ is chosen as in DQN."""
        both = joint(rows)
        following = self.target.of_minibatch(*both)[len(rows.x) :]  # [B, N, n]
        chooses = self.net.of_minibatch(*both)[len(rows.x) :] if self.config.double else following
        z = of_actions(following, best_action(chooses.mean(1), rows.next_mask))
        return rows.reward[:, None] + rows.discount[:, None] * z

    def loss(self, rows: Transitions) -> CriticLoss:
        """E[w · quantile Huber loss] for the quantiles of Q(s, a)."""
        quantiles = of_actions(self.net.trained(*joint(rows))[: len(rows.x)], rows.action)
        targets = self.targets(rows)
        loss = (rows.weight * quantile_huber(quantiles, targets)).mean()
        values = quantiles.mean(-1)  # [B]
        return CriticLoss(loss, values - targets.mean(-1), {"q_mean": values.mean()})

    def start_from(self, start: Start) -> None:
        """See `Algorithm.start_from`. Raises `UsageError` if the earlier run's policy has no quantiles."""
        if "statistics" not in start.state:
            raise UsageError(
                "start_from: expected a run of rainbow with a checkpoint, got action values without the quantiles whose "
                "means they are"
            )
        super().start_from(start._replace(acting=len(self.net.flat)))
        self.net.statistics.copy_(start.state["statistics"])


def joint(rows: Transitions) -> tuple[Tensor, list[Tensor]]:
    """Features [2 B, D] and images [2 B, *leaf] of the observations, then of the next observations."""
    images = [torch.cat(both) for both in zip(rows.images, rows.next_images, strict=True)]
    return torch.cat((rows.x, rows.next_x)), images


def of_actions(quantiles: Tensor, action: Tensor) -> Tensor:
    """The quantiles [B, N] of one action per row, from the quantiles [B, N, n] of all actions. `action` is [B] int64."""
    return quantiles.take_along_dim(action[:, None, None], -1)[..., 0]
