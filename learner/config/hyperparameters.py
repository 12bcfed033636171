"""The settings (hyperparameters) of each algorithm. The texts under the fields are also the command line's help.

The settings are plain data, separate from the algorithms, so reading a command line needs no torch. Your own algorithm names
its record in its attribute `Config` (learner/config/algorithm_names.py).

Rule: other files ask an algorithm's record what the algorithm can do, through `AlgorithmConfig`. If they need a setting that
only some algorithms have, `AlgorithmConfig` has a property of the same name: its value for algorithms without the setting.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import msgspec

from millrace.flags.fields import Flag, NotNegative, Positive
from millrace.learner.config.resume_rules import Fixed, Free
from millrace.protocol.bounds import Count, Natural
from millrace.protocol.errors import UsageError
from millrace.protocol.own_module import is_name

LEAST_ROLLOUT = 32  # steps of a rollout in PPO: in shorter ones, advantages depend more on the critic than on rewards
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
Schedule = Literal["constant", "linear"]
Optimizer = Literal["rmsprop", "adam"]


class AlgorithmConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings that every algorithm has. Each algorithm's record derives from this one.

    Every field has a default. Its type says which values are allowed, and whether a resumed run may change them:
    `Free[...]`, `Adaptable[...]` or `Fixed[...]` (learner/config/resume_rules.py).
    """

    rollout_steps: Free[Count] = 128
    """T, the number of steps of each env copy in a rollout."""
    net: Fixed[tuple[Count, ...]] = (64, 64)
    """Sizes of the hidden layers of the actor, and likewise of the critic; or of the Q-network."""
    activation: Fixed[Literal["tanh", "relu"]] = "tanh"
    """Activation function of the hidden layers."""
    encoder: Fixed[str | None] = None
    """A torch module of your own in front of the hidden layers, such as my_package.networks:factory.
    See protocol/policy/own_encoder.py.
    """
    normalize_observations: Fixed[bool] = False
    """Normalize observations, except images: subtract the running mean, divide by the running standard deviation, clip to
    ±10.
    """
    gamma: Fixed[Fraction] = 0.99
    """Discount factor."""

    replays: ClassVar[bool] = False
    """Whether the algorithm learns from a replay buffer."""
    only_clones: ClassVar[bool] = False
    """Whether the algorithm can do nothing with prior data but clone it."""

    @property
    def core(self) -> str | None:
        """The kind of recurrent layer."""
        return None

    @property
    def gradient_steps(self) -> int | None:
        """The number of gradient steps in an update; None if it depends on the number of rows."""
        return None

    @property
    def replay_size(self) -> int:
        """The capacity of the replay buffer."""
        return 0

    @property
    def learning_starts(self) -> int:
        """The number of env steps before the first gradient step."""
        return 0

    @property
    def clone_epochs(self) -> int:
        """The number of epochs of cloning before the first rollouts."""
        return 0

    @property
    def prior_steps(self) -> int:
        """The number of gradient steps on only prior data before the first rollouts."""
        return 0

    @property
    def least_rollout(self) -> int:
        """The smallest number of steps in a rollout from which the algorithm learns as well as with its own number."""
        return min(LEAST_ROLLOUT, self.rollout_steps)

    def minibatch_rows(self, envs: int) -> int:
        """The number of rows in a minibatch of an update, which has the rollouts of this number of env copies."""
        return envs * self.rollout_steps

    def check(self) -> None:
        """Raise `UsageError` if these settings, each valid on its own, aren't valid together."""
        if self.encoder is not None and not is_name(self.encoder):
            raise UsageError(f"encoder {self.encoder}: expected module:factory, as in my_package.networks:encoder")


class PolicyGradientConfig(AlgorithmConfig, frozen=True):
    """Settings of every algorithm with an actor and a critic."""

    only_clones: ClassVar[bool] = True

    shared_net: Fixed[bool] = False
    """Let actor and critic share their hidden layers."""
    learning_rate: Free[Positive] = 3e-4
    """Learning rate of the optimizer."""
    learning_rate_schedule: Free[Schedule] = "constant"
    """linear: the learning rate falls to zero over the run."""
    optimizer: Fixed[Optimizer] = "adam"
    """Optimizer: rmsprop (α = 0.99) or adam, each with ε = 1e-5."""
    ent_coef: Free[NotNegative] = 0.0
    """Weight of the entropy bonus in the loss."""
    ent_coef_schedule: Free[Schedule] = "constant"
    """linear: ent_coef falls to zero over the run."""
    vf_coef: Free[NotNegative] = 0.5
    """Weight of the value loss in the total loss."""
    max_grad_norm: Free[Positive] = 0.5
    """Clip the norm of the gradient to this."""
    log_std_init: Fixed[Annotated[float, msgspec.Meta(ge=-20, le=20)]] = 0.0
    """Initial logarithm of the standard deviation of continuous (Box) actions."""
    normalize_rewards: Fixed[bool] = False
    """Divide rewards by the running standard deviation of the discounted return, and clip them to ±10."""
    clone_epochs: Free[Natural] = 0
    """Number of epochs of cloning on the --prior dataset, before the first rollouts are collected: the actor learns the
    dataset's actions, the critic its returns. Needs --prior.
    """


class RecurrentConfig(PolicyGradientConfig, frozen=True):
    """Settings of every algorithm that can train a recurrent policy."""

    core: Fixed[Literal["lstm", "gru"] | None] = None
    """Recurrent layer in front of the hidden layers. Minibatches then consist of whole sequences: all T steps of some env
    copies.
    """
    core_size: Fixed[Count] = 64
    """Number of units of the recurrent layer."""

    def check(self) -> None:
        """See `AlgorithmConfig`."""
        if self.core is not None and self.clone_epochs:
            raise UsageError(f"clone_epochs: expected 0 with a recurrent core, got {self.clone_epochs}; take --core none")
        super().check()


class ActorCriticConfig(RecurrentConfig, frozen=True):
    """Settings of an actor-critic with generalized advantage estimation and several epochs of minibatches."""

    batch_size: Free[Count] = 64
    """Largest number of rows (steps of one env copy) in a minibatch. With core, whole sequences may exceed it."""
    n_epochs: Free[Count] = 10
    """Number of epochs: how many times an update uses each row."""
    gae_lambda: Free[Fraction] = 0.95
    """λ of generalized advantage estimation. 1: Monte Carlo return. 0: one-step TD error."""
    normalize_advantage: Free[bool] = True
    """Normalize the advantages of each minibatch to mean 0 and standard deviation 1, unless the policy was cloned."""

    def minibatch_rows(self, envs: int) -> int:
        """See `AlgorithmConfig`."""
        return self.batch_size


class PPOConfig(ActorCriticConfig, frozen=True):
    """Proximal policy optimization (Schulman et al. 2017)."""

    normalize_observations: Fixed[bool] = True
    """Normalize observations, except images: subtract the running mean, divide by the running standard deviation, clip to
    ±10. docs/how-to/algorithms.md shows why PPO does this by default.
    """
    normalize_rewards: Fixed[bool] = True
    """Divide rewards by the running standard deviation of the discounted return, and clip them to ±10."""
    clip_range: Free[Positive] = 0.2
    """ε of the clipped objective: the ratio of the new to the old action probability is clipped to 1 ± ε."""
    clip_range_schedule: Free[Schedule] = "constant"
    """linear: clip_range falls to zero over the run."""
    clip_range_vf: Free[Positive | None] = None
    """Clip each value's change in an update to this, in units of (normalized) reward. none: no clipping."""
    target_kl: Free[Positive | None] = None
    """End an update when the KL divergence from the old policy exceeds 1.5 times this. none: never."""


class A2CConfig(RecurrentConfig, frozen=True):
    """Advantage actor-critic: one gradient step on each batch (Mnih et al. 2016)."""

    rollout_steps: Free[Count] = 8
    """T, the number of steps of each env copy in a rollout."""
    learning_rate: Free[Positive] = 7e-4
    """Learning rate of the optimizer."""
    optimizer: Fixed[Optimizer] = "rmsprop"
    """Optimizer: rmsprop (α = 0.99) or adam, each with ε = 1e-5."""
    gae_lambda: Free[Fraction] = 1.0
    """λ of generalized advantage estimation. 1: Monte Carlo return. 0: one-step TD error."""
    normalize_advantage: Free[bool] = False
    """Normalize the advantages of each batch to mean 0 and standard deviation 1, unless the policy was cloned."""


class IMPALAConfig(RecurrentConfig, frozen=True):
    """Actor-critic with V-trace, which corrects for rollouts with older weights (max_lag above 0; Espeholt et al. 2018)."""

    rollout_steps: Free[Count] = 32
    """T, the number of steps of each env copy in a rollout."""
    learning_rate: Free[Positive] = 7e-4
    """Learning rate of the optimizer."""
    optimizer: Fixed[Optimizer] = "rmsprop"
    """Optimizer: rmsprop (α = 0.99) or adam, each with ε = 1e-5."""
    n_epochs: Free[Count] = 1
    """Number of epochs: how many times an update uses each row. V-trace is recomputed in each epoch."""
    minibatches: Free[Count] = 1
    """Number of minibatches (gradient steps) in an epoch."""
    vtrace_lambda: Free[Fraction] = 1.0
    """λ of V-trace. 1: as in the paper. 0: one step."""
    rho_bar: Free[Positive] = 1.0
    """ρ̄ of V-trace: importance weights of TD errors are clipped to this. The larger ρ̄ is, the closer the learned values
    are to the newest policy's values; without clipping, they are the same.
    """
    c_bar: Free[Positive] = 1.0
    """c̄ of V-trace: importance weights of traces are clipped to this. It determines how far back the effect of a TD error
    reaches.
    """

    def minibatch_rows(self, envs: int) -> int:
        """See `AlgorithmConfig`."""
        return envs * self.rollout_steps // self.minibatches


class REINFORCEConfig(PolicyGradientConfig, frozen=True):
    """Monte Carlo policy gradient on whole episodes (Williams 1992)."""

    rollout_steps: Fixed[Count] = 1001
    """T, the number of steps of each env copy in a rollout. Must be larger than the length of any episode."""
    learning_rate: Free[Positive] = 2e-3
    """Learning rate of the optimizer."""
    normalize_rewards: Fixed[bool] = True
    """Divide rewards by the running standard deviation of the discounted return, and clip them to ±10. Without this, the
    baseline's loss dominates the gradient.
    """
    baseline: Free[bool] = True
    """Subtract the critic's value estimate from the return."""
    normalize_returns: Free[bool] = True
    """Normalize the returns of each batch (minus the baseline) to mean 0 and standard deviation 1."""

    @property
    def least_rollout(self) -> int:
        """See `AlgorithmConfig`. A rollout must contain whole episodes."""
        return self.rollout_steps


class OffPolicyConfig(AlgorithmConfig, frozen=True):
    """Settings of every algorithm that learns from a replay buffer."""

    replays: ClassVar[bool] = True

    rollout_steps: Free[Count] = 32
    """T, the number of steps of each env copy in a rollout."""
    activation: Fixed[Literal["tanh", "relu"]] = "relu"
    """Activation function of the hidden layers."""
    core: Fixed[Literal["lstm", "gru"] | None] = None
    """Recurrent layer in front of the hidden layers. A gradient step then uses whole sequences: the rollout_steps steps of
    an env copy, preceded by the copy's previous rollout as burn-in. Actor and critics share the layer, and the critics' loss
    trains it.
    """
    core_size: Fixed[Count] = 64
    """Number of units of the recurrent layer."""
    learning_rate: Free[Positive] = 3e-4
    """Learning rate of the optimizer."""
    learning_rate_schedule: Free[Schedule] = "constant"
    """linear: the learning rate falls to zero over the run."""
    batch_size: Free[Count] = 64
    """Number of transitions in a gradient step. With core, as many sequences as make up this number, but at least 16."""
    learning_starts: Free[Natural] = 1000
    """Number of env steps before the first gradient step."""
    replay_size: Fixed[Count] = 100_000
    """Capacity of the replay buffer, in transitions; the newest are kept. The final observation of a truncated episode takes
    up the space of one transition.
    """
    priority_alpha: Fixed[Fraction] = 0.0
    """α of prioritized replay: how strongly the probability of drawing a transition depends on its last TD error. 0: not at
    all. 1: in proportion. Schaul et al. 2016 use 0.6.
    """
    priority_beta: Free[Fraction] = 0.4
    """Initial β of prioritized replay: how much of the bias importance weights correct. It grows to 1 (all) over the run."""
    prior_share: Free[Fraction] = 0.5
    """Share of each minibatch that is prior data, in a run with --prior (Ball et al. 2023 use 0.5)."""
    prior_steps: Free[Natural] = 0
    """Number of gradient steps on only prior data, before the first rollouts are collected. Needs --prior."""
    hindsight: Fixed[Fraction] = 0.0
    """Hindsight experience replay: the share of a minibatch's transitions whose goal is replaced by a goal that was achieved
    later in the episode. 0: off. Andrychowicz et al. 2017 use 0.8. Needs goal_reward, and observations with achieved_goal
    and desired_goal.
    """
    goal_reward: Annotated[Free[str | None], Flag("NAME")] = None
    """How the environment computes rewards from achieved and desired goals, for hindsight. sparse:0.05: 0 within this
    distance of the goal, else -1. success:0.45: 1 within this distance, else 0. dense: minus the distance. Or your own
    function, such as my_module:reward, which takes two arrays [B, G] and returns an array [B].
    """
    goal_ends: Free[Positive | None] = None
    """The distance from the goal at which an episode terminates, for hindsight. none: reaching the goal doesn't end it."""
    n_step: Free[Count] = 1
    """Number of rewards in a target before it bootstraps. With several agents, each agent's own steps count."""
    tau: Free[Annotated[float, msgspec.Meta(gt=0, le=1)]] = 0.005
    """τ of the polyak update: the fraction by which each gradient step moves the target network toward the network."""
    normalize_rewards: Fixed[bool] = False
    """When rewards are drawn from the buffer, divide them by the running standard deviation of the discounted return, and
    clip them to ±10. With n_step, the sum of n rewards is clipped.
    """

    @property
    def least_rollout(self) -> int:
        """See `AlgorithmConfig`. With a recurrent layer, a gradient step uses the sequences of whole rollouts."""
        return 1 if self.core is None else self.rollout_steps

    def minibatch_rows(self, envs: int) -> int:
        """See `AlgorithmConfig`."""
        return self.batch_size


class QLearningConfig(OffPolicyConfig, frozen=True):
    """Settings of DQN and Rainbow."""

    optimizer: Fixed[Literal["adam", "adamw"]] = "adam"
    """Optimizer. adamw: Adam with a decoupled weight decay of 0.01."""
    amsgrad: Fixed[bool] = False
    """Use the AMSGrad variant of the optimizer."""
    gradient_steps: Free[Count] = 64
    """Number of gradient steps in an update. There is one update for every envs x rollout_steps env steps, so this setting
    determines the replay ratio.
    """
    double: Free[bool] = True
    """Double Q-learning: the network chooses the next action, and the target network evaluates it."""
    dueling: Fixed[bool] = False
    """Dueling network: an action value is the value of the state plus the action's advantage minus the mean advantage."""
    target_every: Free[Count] = 250
    """Number of gradient steps between two updates of the target network."""
    tau: Free[Annotated[float, msgspec.Meta(gt=0, le=1)]] = 1.0
    """Fraction by which each update of the target network moves it toward the network. 1: it becomes a copy. With a small
    fraction, such as 0.005, set target_every to 1 (polyak averaging).
    """
    epsilon_start: Free[Fraction] = 1.0
    """Initial probability ε of a random action."""
    epsilon_end: Free[Fraction] = 0.05
    """Final probability ε of a random action."""
    epsilon_schedule: Free[Literal["linear", "exponential"]] = "linear"
    """How ε falls from its initial to its final value."""
    epsilon_steps: Free[Count] = 10_000
    """Number of env steps, summed over all env copies, over which ε falls. With exponential, the number of env steps after
    which the difference between ε and its final value has fallen to 1/e of what it was.
    """
    max_grad_norm: Free[Positive | None] = None
    """Clip the norm of the gradient to this. none: no clipping."""
    max_grad_value: Free[Positive | None] = None
    """Clip each entry of the gradient to ± this value, before the gradient's norm is clipped. none: no clipping."""


class DQNConfig(QLearningConfig, frozen=True):
    """Deep Q-learning (Mnih et al. 2015), with the common extensions."""

    loss: Free[Literal["huber", "squared"]] = "huber"
    """Loss function of the TD error. huber: squared up to 1 and linear beyond."""


class RainbowConfig(QLearningConfig, frozen=True):
    """Rainbow (Hessel et al. 2018), which learns quantiles of the return (Dabney et al. 2018), without noisy networks."""

    rollout_steps: Free[Count] = 8
    """T, the number of steps of each env copy in a rollout."""
    net: Fixed[tuple[Count, ...]] = (128, 128)
    """Sizes of the hidden layers of the Q-network."""
    learning_rate: Free[Positive] = 5e-4
    """Learning rate of the optimizer."""
    learning_rate_schedule: Free[Schedule] = "linear"
    """linear: the learning rate falls to zero over the run."""
    priority_alpha: Fixed[Fraction] = 0.5
    """α of prioritized replay: how strongly the probability of drawing a transition depends on its last TD error. 0: not at
    all. 1: in proportion.
    """
    n_step: Free[Count] = 3
    """Number of rewards in a target before it bootstraps. With several agents, each agent's own steps count."""
    core: Fixed[Literal["lstm", "gru"] | None] = None
    """Must be none, because rainbow can't train a recurrent policy. dqn can."""
    quantiles: Fixed[Annotated[int, msgspec.Meta(ge=2)]] = 16
    """Number of quantiles of the return that are learned for each action."""
    batch_norm: Fixed[bool] = True
    """Use batch normalization on the inputs and before each activation of the hidden layers (Bhatt et al. 2024)."""
    dueling: Fixed[bool] = True
    """Dueling network: an action value is the value of the state plus the action's advantage minus the mean advantage."""
    target_every: Free[Count] = 1
    """Number of gradient steps between two updates of the target network."""
    tau: Free[Annotated[float, msgspec.Meta(gt=0, le=1)]] = 0.005
    """Fraction by which each update of the target network moves it toward the network."""
    epsilon_end: Free[Fraction] = 0.02
    """Final probability ε of a random action."""
    max_grad_norm: Free[Positive | None] = 10.0
    """Clip the norm of the gradient to this. none: no clipping."""

    def check(self) -> None:
        """See `AlgorithmConfig`."""
        if self.core is not None:
            raise UsageError(f"core: rainbow has no memory: expected none, got {self.core}; take --algo dqn")
        super().check()


class ContinuousConfig(OffPolicyConfig, frozen=True):
    """Settings of SAC and TD3: the defaults of Stable-Baselines3, except for TD3's network and exploration noise."""

    rollout_steps: Free[Count] = 8
    """T, the number of steps of each env copy in a rollout."""
    net: Fixed[tuple[Count, ...]] = (256, 256)
    """Sizes of the hidden layers of the actor and of each critic."""
    batch_size: Free[Count] = 256
    """Number of transitions in a gradient step. With core, as many sequences as make up this number, but at least 16."""
    learning_starts: Free[Natural] = 100
    """Number of env steps before the first gradient step. Until then, actions are drawn uniformly."""
    replay_size: Fixed[Count] = 1_000_000
    """Capacity of the replay buffer, in transitions; the newest are kept. The final observation of a truncated episode takes
    up the space of one transition.
    """
    clone_epochs: Free[Natural] = 0
    """Number of epochs of cloning on the --prior dataset, before prior_steps and the first rollouts: the actor learns the
    dataset's actions. Needs --prior.
    """
    updates_per_step: Free[Annotated[float, msgspec.Meta(gt=0, le=1e6)]] = 1.0
    """Replay ratio: gradient steps per env step after learning_starts. It is exact for any size of rollouts."""
    random_shift: Free[Annotated[int, msgspec.Meta(ge=0, le=64)]] = 4
    """Largest random shift, in pixels, of an image each time it is in a minibatch (DrQ-v2). It has no effect on observations
    without images.
    """


class SACConfig(ContinuousConfig, frozen=True):
    """Soft actor-critic (Haarnoja et al. 2018) with two critics and an automatic temperature."""

    ent_coef: Fixed[Positive | None] = None
    """Temperature α: the weight of the entropy. none: α is learned so that the entropy stays near target_entropy."""
    target_entropy: Free[float | None] = None
    """The entropy that a learned temperature aims for. none: minus the dimension of the action."""


class TQCConfig(SACConfig, frozen=True):
    """Truncated quantile critics (Kuznetsov et al. 2020): SAC whose critics learn quantiles of the return."""

    critics: Fixed[Count] = 2
    """Number of critics."""
    quantiles: Fixed[Count] = 25
    """Number of quantiles that each critic learns."""
    dropped_quantiles: Free[Natural] = 2
    """Number of each critic's highest quantiles that are left out of targets, so that values are not overestimated."""


class NormalizedConfig(SACConfig, frozen=True):
    """Settings of SAC with batch normalization in the actor and the critics."""

    net: Fixed[tuple[Count, ...]] = (256, 256)
    """Sizes of the hidden layers of the actor."""
    critic_net: Fixed[tuple[Count, ...]] = (256, 256)
    """Sizes of the hidden layers of each critic."""
    learning_starts: Free[Natural] = 5000
    """Number of env steps before the first gradient step. Until then, actions are drawn uniformly."""
    policy_delay: Free[Count] = 3
    """Number of the critics' gradient steps for each step of the actor and the temperature."""


class CrossQConfig(NormalizedConfig, frozen=True):
    """CrossQ (Bhatt et al. 2024): batch normalization in place of target networks."""

    critic_net: Fixed[tuple[Count, ...]] = (1024, 1024)
    """Sizes of the hidden layers of each critic."""
    learning_rate: Free[Positive] = 1e-3
    """Learning rate of the optimizers."""
    renormalize_after: Free[Natural] = 100_000
    """Number of gradient steps after which batch normalization becomes batch renormalization."""


class XQCConfig(NormalizedConfig, frozen=True):
    """XQC (Palenicek et al. 2025): batch normalization, weights of norm 1, and critics that learn a return distribution."""

    atoms: Fixed[Annotated[int, msgspec.Meta(ge=2)]] = 101
    """Number of returns, equally spaced from -return_bound to return_bound, whose probabilities a critic learns."""
    return_bound: Fixed[Positive] = 5.0
    """Largest absolute return, in units of scaled reward, that a critic can learn."""
    normalize_rewards: Fixed[bool] = True
    """Divide rewards by the running standard deviation of the discounted return, or by more if necessary, so that neither
    the discounted return so far nor the value of continuing after a truncated episode exceeds return_bound.
    """


class TD3Config(ContinuousConfig, frozen=True):
    """Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018)."""

    learning_rate: Free[Positive] = 1e-3
    """Learning rate of the optimizers."""
    exploration_noise: Free[NotNegative] = 0.1
    """Standard deviation of the noise that workers add to actions, which are in [-1, 1]."""
    policy_delay: Free[Count] = 2
    """Number of the critics' gradient steps for each step of the actor and the target networks."""
    target_noise: Free[NotNegative] = 0.2
    """Standard deviation of the noise that is added to the target actor's actions."""
    target_noise_clip: Free[NotNegative] = 0.5
    """Clip target_noise to ± this value."""


HYPERPARAMETERS: dict[str, type[AlgorithmConfig]] = {
    "ppo": PPOConfig,
    "a2c": A2CConfig,
    "dqn": DQNConfig,
    "rainbow": RainbowConfig,
    "impala": IMPALAConfig,
    "reinforce": REINFORCEConfig,
    "sac": SACConfig,
    "td3": TD3Config,
    "tqc": TQCConfig,
    "crossq": CrossQConfig,
    "xqc": XQCConfig,
}
"""The settings of each built-in algorithm, by its name. Other tables of the algorithms follow from this one."""

WITHOUT_REPLAY = [name for name, record in HYPERPARAMETERS.items() if not record.replays]
"""The names of the built-in algorithms without a replay buffer."""


def algorithms_with(name: str) -> str:
    """The end of an error: which algorithms have a setting of this name; empty if none of them has one."""
    owners = [algo for algo, record in HYPERPARAMETERS.items() if name in record.__struct_fields__]
    return f"; it is one of {', '.join(owners)} alone" if owners else ""
