"""Everything that you need to write your own algorithm. Importing this module imports PyTorch.

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

On the second, you derive a class from `Algorithm` and write the whole update. `millrace.testing.check_algorithm` finds
mistakes in a class written at either level. Use the class with `millrace train CartPole-v1 --algo my_module:Mine --penalty
0.2`, or with `millrace.train("CartPole-v1", algo=Mine, penalty=0.2)`.

The algorithm itself:

- `Algorithm`: the base class of all algorithms. `GradientDescent`: the base of the built-in ones, with their optimizers,
  schedules, running statistics, `UpdateMetrics` and saved state. `ActorCritic`: the base of algorithms with an actor and a
  critic (`PPO`, `A2C`, `IMPALA`, `REINFORCE`). `OffPolicy`: the base of algorithms with a replay buffer (`DQN`,
  `Rainbow`). `Continuous`: the base of those for actions in a bounded Box, with an exact replay ratio (`SAC`, `TD3`, `TQC`,
  `CrossQ`, `XQC`).
- `AlgorithmConfig`, `ActorCriticConfig`, `OffPolicyConfig` and `ContinuousConfig`: base classes for an algorithm's `Config`.
  `PPOConfig` and similar classes are the settings of the built-in algorithms. Every setting has a default value and a type,
  which may have bounds: `Annotated[float, msgspec.Meta(gt=0)]`. The string under a setting is its help text.
- `Free`, `Adaptable` and `Fixed`: mark whether a resumed run may change a setting, as in `n_steps: Free[int] = 3`. A setting
  without a mark is free if it is a float, and fixed otherwise.

What an algorithm learns from:

- `Batch`: the rollouts of all lanes side by side, as numpy arrays [T, ΣN, …]. `LossInput`: the rows of a minibatch, which
  `ActorCritic.loss` gets.
- `Observations` and `Estimates`: argument and result of `ActorCritic.estimate`.
- `PriorData`: the dataset that `Algorithm.add_prior` gets.
- `Start`: what a run with `--from` takes over from the other run; it is passed to `Algorithm.start_from`.
- `PolicySpec`, `ActionSpec` and `Leaf`: the policy and the spaces, as plain data.

Tools:

- `gae` and `vtrace`: compute advantages and value targets from arrays [T, N] and their `EpisodeEnds`.
- `ActorCriticNetwork`, `QNetwork` and `ActorAndCritics`: networks whose first parameters are those that workers act with.
  `log_prob_and_entropy`, `policy_log_prob` and `squashed_sample` take the outputs of these networks. `trainable`: makes a
  flat tensor a leaf of the autograd graph.
- `ReplayBuffer`: returns a `Sample` of transitions. `MixedReplay` also samples prior data; `Hindsight` replaces the goals of
  transitions; `SequenceReplay` returns a `SequenceSample`, for a policy with memory. `Transitions`: the tensors of either
  kind of sample, with their `Sequences`. `CriticLoss`: the loss of the critics, or of the Q-network, on a minibatch.
- `Encoder`: the layers before the hidden layers of a network. `RecurrentInput`: the input of its recurrent core.
- `ObservationNormalizer` and `RewardScaler`: running statistics of observations and of returns.
- `features` and `normalize`: turn observations into network input. `random_shift`: shifts images at random.
- `UsageError`: raise it, with a one-line message, for settings or spaces that cannot be used.
- `torch_seed`: the seed of the random stream for a `Purpose`, which is independent of all other streams of the run.
- `check_finite`: the check before a gradient step. `scheduled`: the current value of a setting that decreases over the run.
"""

from __future__ import annotations

from millrace.learner.algorithms.a2c import A2C
from millrace.learner.algorithms.actor_critic import ActorCritic, Estimates
from millrace.learner.algorithms.algorithm import Algorithm, Start
from millrace.learner.algorithms.bodies.autograd_leaves import trainable
from millrace.learner.algorithms.bodies.networks import ActorAndCritics, ActorCriticNetwork, QNetwork
from millrace.learner.algorithms.crossq import CrossQ
from millrace.learner.algorithms.dqn import DQN
from millrace.learner.algorithms.gradient_descent import GradientDescent, UpdateMetrics, check_finite, scheduled
from millrace.learner.algorithms.impala import IMPALA
from millrace.learner.algorithms.minibatches import LossInput, Observations
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.algorithms.rainbow import Rainbow
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
from millrace.learner.algorithms.tqc import TQC
from millrace.learner.algorithms.xqc import XQC
from millrace.learner.config.hyperparameters import (
    A2CConfig,
    ActorCriticConfig,
    AlgorithmConfig,
    ContinuousConfig,
    CrossQConfig,
    DQNConfig,
    IMPALAConfig,
    OffPolicyConfig,
    PPOConfig,
    RainbowConfig,
    REINFORCEConfig,
    SACConfig,
    TD3Config,
    TQCConfig,
    XQCConfig,
)
from millrace.learner.config.resume_rules import Adaptable, Fixed, Free
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.encoder import Encoder, RecurrentInput
from millrace.protocol.policy.features import features
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
    "TQC",
    "XQC",
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
    "CrossQ",
    "CrossQConfig",
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
    "Rainbow",
    "RainbowConfig",
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
    "TQCConfig",
    "Transitions",
    "UpdateMetrics",
    "UsageError",
    "XQCConfig",
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
