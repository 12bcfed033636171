"""Each algorithm's settings: their names, meanings, bounds and defaults. The texts are the help of the command line.

Plain data, apart from the algorithms so that reading a command line needs no torch.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Schedule = Literal["constant", "linear"]


class Hyperparameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every algorithm has."""

    rollout_steps: Count = 128
    """T, steps of each env copy in a rollout"""
    net: tuple[Count, ...] = (64, 64)
    """hidden layers of the actor, and of the critic; or of the action values"""
    activation: Literal["tanh", "relu"] = "tanh"
    """of the hidden layers"""
    normalize_observations: bool = False
    """subtract the running mean, divide by the running standard deviation, clip to ±10 (not images)"""
    gamma: Share = 0.99
    """discount"""


class PPOConfig(Hyperparameters, frozen=True):
    """Proximal policy optimisation."""

    learning_rate: Positive = 3e-4
    """step size of Adam"""
    learning_rate_schedule: Schedule = "constant"
    """linear: falls to zero over the run"""
    batch_size: Count = 64
    """rows of a minibatch, at most"""
    n_epochs: Count = 10
    """times each row is used in an update"""
    gae_lambda: Share = 0.95
    """λ of the advantage estimate: 1 is the Monte-Carlo return, 0 one step"""
    clip_range: Positive = 0.2
    """how far the probability of an action may move in an update: its ratio is clipped to 1 ± this"""
    clip_range_schedule: Schedule = "constant"
    """linear: falls to zero over the run"""
    ent_coef: NotNegative = 0.0
    """weight of the entropy bonus"""
    vf_coef: NotNegative = 0.5
    """weight of the value loss"""
    max_grad_norm: Positive = 0.5
    """longer gradients are shortened to this"""
    normalize_advantage: bool = True
    """advantages of a minibatch get mean 0 and standard deviation 1"""
    target_kl: Positive | None = None
    """stop the update once the policy moved further than 1.5 times this"""
    normalize_rewards: bool = False
    """divide rewards by the running standard deviation of the discounted return"""


HYPERPARAMETERS: dict[str, type[Hyperparameters]] = {"ppo": PPOConfig}
