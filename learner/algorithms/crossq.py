"""CrossQ (Bhatt et al. 2024): SAC with batch normalization in actor and critics, and without target networks.

The newest critics also evaluate the next observations. This is stable because observations and next observations pass
through the critics together, and are normalized in the same way. `NormalizedSAC` has the parts that CrossQ and XQC share.
"""

from __future__ import annotations

from millrace.learner.algorithms.bodies.actor_with_critics import ActorWithCritics, layer_sizes
from millrace.learner.algorithms.bodies.normalized_sac import NormalizedSAC
from millrace.learner.algorithms.bodies.stacked_mlps import MLPShape, Normalized
from millrace.learner.algorithms.replay.off_policy import CriticLoss
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import CrossQConfig
from millrace.protocol.specs import PolicySpec


class CrossQ(NormalizedSAC):
    """An actor, two critics without target networks, and the temperature."""

    Config = CrossQConfig
    ADAM = {"betas": (0.5, 0.999)}
    config: CrossQConfig

    def __init__(
        self, config: CrossQConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        super().__init__(config, policy, total_steps=total_steps, seed=seed, device=device)
        self.target = self.net
        del self.tensors["target"]

    def networks(self, device: str) -> ActorWithCritics:
        """See `Continuous`."""
        relu = self.policy.activation == "relu"
        actor, critic = layer_sizes(self.policy, self.config.critic_net, 1)
        return ActorWithCritics(
            self.policy,
            MLPShape(1, actor, relu, Normalized.AFTER, output_gain=0.01),
            MLPShape(2, critic, relu, Normalized.AFTER),
            lambda outputs: outputs[..., 0],
            device,
            self.seed,
        )

    def critic_loss(self, rows: Transitions) -> CriticLoss:
        """½ Σ E[w (Q(s, a) − y)²] over both critics, where y = Σ γⁱ r + γᵏ (min Q(s′, a′) − α log π(a′|s′)).

        One pass computes both Q(s, a) and Q(s′, a′). The gradient treats y as a constant, but it flows through the
        minibatch's statistics, to which s′ contributes.
        """
        self.net.renormalizes = self.gradient_steps >= self.config.renormalize_after
        joint = self.joint(rows)
        size = len(rows.x)
        both = self.net.outputs(joint.x, joint.action)[..., 0]  # [2, 2 B]
        values = both[:, :size]
        next_values = both[:, size:].detach()
        y = rows.reward + rows.discount * (next_values.amin(0) - self.temperature * joint.next_log_prob)
        error = values - y
        loss = 0.5 * (rows.weight * error.square()).mean(1).sum()
        return CriticLoss(loss, error.detach().abs().mean(0), {"q_mean": values.mean()})
