"""Everything that you need for your own algorithm. Importing this module imports PyTorch.

There are two levels. On the first, you write only the loss; millrace does everything else in an update:

>>> import millrace
>>> from millrace.algorithms import ActorCritic, ActorCriticConfig
>>> class Mine(ActorCritic):
...     class Config(ActorCriticConfig, frozen=True):
...         penalty: float = 0.1
...         "Weight of the squared log-ratio."
...
...     def loss(self, rows):
...         log_ratio = rows.log_prob_now - rows.log_prob
...         penalty, value = log_ratio.square().mean(), (rows.value - rows.target).square().mean()
...         loss = -(log_ratio.exp() * rows.advantage).mean() + self.config.penalty * penalty + 0.5 * value
...         return loss, {"penalty": penalty}
>>> run = millrace.train("CartPole-v1", algo=Mine, penalty=0.2, steps=500, workers=1, eval_episodes=2, progress=False)

On the second, a class derives from `Algorithm` and makes the whole update. `millrace.testing.check_algorithm` finds mistakes
in a class of either level. Use the class with `millrace train CartPole-v1 --algo my_module:Mine --penalty 0.2`, or with
`millrace.train("CartPole-v1", algo=Mine, penalty=0.2)`.

The algorithm itself:

- `Algorithm`, the base of all; `GradientDescent`, the base of the built-in ones: optimizers, schedules, statistics,
  `UpdateMetrics`, the state; `ActorCritic`, the base of algorithms with an actor and a critic: `PPO`, `A2C`, `IMPALA` and
  `REINFORCE`; `OffPolicy`, the base of algorithms with a replay buffer: `DQN`, `SAC` and `TD3`. The last two share
  `Continuous`: actions in a bounded Box, an exact replay ratio.
- `AlgorithmConfig`, `ActorCriticConfig`, `OffPolicyConfig` and `ContinuousConfig`, the bases of `Config`; `PPOConfig` and so
  on. Every setting has a default value and a type, perhaps with bounds: `Annotated[float, msgspec.Meta(gt=0)]`. The text
  under it is its help.
- `Free`, `Adaptable` and `Fixed` say whether a resumed run may change a setting: `n_steps: Free[int] = 3`. Without one, a
  float is free and anything else is fixed.

What it learns from:

- `Batch`: rollouts side by side, numpy arrays [T, ΣN, …]. `LossInput`: the rows of a minibatch that `ActorCritic.loss` gets.
- `Observations` and `Estimates`: argument and result of `ActorCritic.estimate`.
- `PriorData`: the dataset that `Algorithm.add_prior` gets.
- `Start`: what a run with `--from` takes from another one; `Algorithm.start_from` gets it.
- `PolicySpec`, `ActionSpec` and `Leaf`: the policy and the spaces, as plain data.

Tools:

- `gae`, `vtrace` and `EpisodeEnds`: advantages and targets of arrays [T, N].
- `ActorCriticNetwork`, `QNetwork` and `ActorAndCritics`: the networks that workers act with, and `log_prob_and_entropy`,
  `policy_log_prob` or `squashed_sample` for their outputs. `trainable`: a leaf of autograd's graph for a flat tensor.
- `ReplayBuffer`, which gives a `Sample` of transitions, `MixedReplay`, which also draws prior data, `Hindsight`, which gives
  transitions another goal, and `SequenceReplay`, which gives a `SequenceSample` for a policy with memory; `Transitions`, the
  tensors of either, with their `Sequences`; and `CriticLoss`, the result of a loss on them.
- `Encoder`: the layers before the hidden layers of a network; `RecurrentInput`: the input of its recurrent core.
- `ObservationNormalizer` and `RewardScaler`: running statistics of observations and of returns.
- `features` and `normalize`: observations as these networks take them; `random_shift`: images, moved at random.
- `UsageError`: raise it, in one line, for settings or spaces that cannot be used.
- `torch_seed` of a `Purpose`: the seed of a random stream that is independent of all others of a run.
- `check_finite` and `scheduled`: the check before a gradient step, and settings that fall over the run.
"""

from __future__ import annotations

from millrace.learner.algorithms.a2c import A2C
from millrace.learner.algorithms.actor_critic import ActorCritic, Estimates
from millrace.learner.algorithms.algorithm import Algorithm, Start
from millrace.learner.algorithms.dqn import DQN
from millrace.learner.algorithms.gradient_descent import GradientDescent, UpdateMetrics, check_finite, scheduled
from millrace.learner.algorithms.impala import IMPALA
from millrace.learner.algorithms.minibatches import LossInput, Observations
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.algorithms.reinforce import REINFORCE
from millrace.learner.algorithms.replay.continuous import Continuous
from millrace.learner.algorithms.replay.hindsight import Hindsight
from millrace.learner.algorithms.replay.mixed_replay import MixedReplay
from millrace.learner.algorithms.replay.off_policy import CriticLoss, OffPolicy
from millrace.learner.algorithms.replay.random_shift import random_shift
from millrace.learner.algorithms.replay.replay_buffer import ReplayBuffer, Sample
from millrace.learner.algorithms.replay.sequence_replay import SequenceReplay, SequenceSample
from millrace.learner.algorithms.replay.transitions import Sequences, Transitions
from millrace.learner.algorithms.returns import EpisodeEnds, gae, vtrace
from millrace.learner.algorithms.running_statistics import ObservationNormalizer, RewardScaler
from millrace.learner.algorithms.sac import SAC
from millrace.learner.algorithms.td3 import TD3
from millrace.learner.config.hyperparameters import (
    A2CConfig,
    ActorCriticConfig,
    AlgorithmConfig,
    ContinuousConfig,
    DQNConfig,
    IMPALAConfig,
    OffPolicyConfig,
    PPOConfig,
    REINFORCEConfig,
    SACConfig,
    TD3Config,
)
from millrace.learner.config.resume_rules import Adaptable, Fixed, Free
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.autograd_leaves import trainable
from millrace.protocol.policy.encoder import Encoder, RecurrentInput
from millrace.protocol.policy.features import features
from millrace.protocol.policy.networks import ActorAndCritics, ActorCriticNetwork, QNetwork
from millrace.protocol.policy.normalize import normalize
from millrace.protocol.policy.torch_distributions import log_prob_and_entropy, policy_log_prob, squashed_sample
from millrace.protocol.random_streams import Purpose, torch_seed
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

__all__ = [
    "A2C",
    "DQN",
    "IMPALA",
    "PPO",
    "REINFORCE",
    "SAC",
    "TD3",
    "A2CConfig",
    "ActionSpec",
    "ActorAndCritics",
    "ActorCritic",
    "ActorCriticConfig",
    "ActorCriticNetwork",
    "Adaptable",
    "Algorithm",
    "AlgorithmConfig",
    "Batch",
    "Continuous",
    "ContinuousConfig",
    "CriticLoss",
    "DQNConfig",
    "Encoder",
    "EpisodeEnds",
    "Estimates",
    "Fixed",
    "Free",
    "GradientDescent",
    "Hindsight",
    "IMPALAConfig",
    "Leaf",
    "LossInput",
    "MixedReplay",
    "ObservationNormalizer",
    "Observations",
    "OffPolicy",
    "OffPolicyConfig",
    "PPOConfig",
    "PolicySpec",
    "PriorData",
    "Purpose",
    "QNetwork",
    "REINFORCEConfig",
    "RecurrentInput",
    "ReplayBuffer",
    "RewardScaler",
    "SACConfig",
    "Sample",
    "SequenceReplay",
    "SequenceSample",
    "Sequences",
    "Start",
    "TD3Config",
    "Transitions",
    "UpdateMetrics",
    "UsageError",
    "check_finite",
    "features",
    "gae",
    "log_prob_and_entropy",
    "normalize",
    "policy_log_prob",
    "random_shift",
    "scheduled",
    "squashed_sample",
    "torch_seed",
    "trainable",
    "vtrace",
]
