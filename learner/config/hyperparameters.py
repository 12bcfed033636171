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
Optimizer = Literal["rmsprop", "adam"]


class Hyperparameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every algorithm has."""

    rollout_steps: Count = 128
    """T, steps of each env copy in a rollout"""
    net: tuple[Count, ...] = (64, 64)
    """hidden layers of the actor, and of the critic; or of the action values"""
    activation: Literal["tanh", "relu"] = "tanh"
    """of the hidden layers"""
    encoder: str | None = None
    """a torch module of your own before all other layers, my_package.networks:factory; see protocol/policy/encoder.py"""
    normalize_observations: bool = False
    """subtract the running mean, divide by the running standard deviation, clip to ±10 (not images)"""
    gamma: Share = 0.99
    """discount"""


class ActorCriticHyperparameters(Hyperparameters, frozen=True):
    """What every algorithm with an actor and a critic has."""

    shared_net: bool = False
    """actor and critic share their hidden layers"""
    learning_rate: Positive = 3e-4
    """step size of the optimiser"""
    learning_rate_schedule: Schedule = "constant"
    """linear: falls to zero over the run"""
    ent_coef: NotNegative = 0.0
    """weight of the entropy bonus"""
    vf_coef: NotNegative = 0.5
    """weight of the value loss"""
    max_grad_norm: Positive = 0.5
    """longer gradients are shortened to this"""
    log_std_init: float = 0.0
    """logarithm of the first standard deviation of Box actions"""
    normalize_rewards: bool = False
    """divide rewards by the running standard deviation of the discounted return"""


class RecurrentHyperparameters(ActorCriticHyperparameters, frozen=True):
    """What every algorithm has whose policy can remember: it learns from rows in their order."""

    core: Literal["lstm", "gru"] | None = None
    """what remembers the episode so far, before the hidden layers; minibatches are then whole columns of env copies"""
    core_size: Count = 64
    """units of the core"""


class PPOConfig(RecurrentHyperparameters, frozen=True):
    """Proximal policy optimisation."""

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
    clip_range_vf: Positive | None = None
    """how far a value may move in an update, in units of (scaled) reward; none: any distance"""
    normalize_advantage: bool = True
    """advantages of a minibatch get mean 0 and standard deviation 1"""
    target_kl: Positive | None = None
    """stop the update once the policy moved further than 1.5 times this"""


class A2CConfig(RecurrentHyperparameters, frozen=True):
    """Advantage actor-critic: one gradient step on each batch."""

    rollout_steps: Count = 8
    """T, steps of each env copy in a rollout"""
    learning_rate: Positive = 7e-4
    """step size of the optimiser"""
    optimizer: Optimizer = "rmsprop"
    """rmsprop (α 0.99) or adam; ε is 1e-5"""
    gae_lambda: Share = 1.0
    """λ of the advantage estimate: 1 is the Monte-Carlo return, 0 one step"""
    normalize_advantage: bool = False
    """advantages of a batch get mean 0 and standard deviation 1"""


class ImpalaConfig(RecurrentHyperparameters, frozen=True):
    """Actor-critic with V-trace: learns from rollouts of older weights too (max_lag above 0)."""

    rollout_steps: Count = 32
    """T, steps of each env copy in a rollout"""
    learning_rate: Positive = 7e-4
    """step size of the optimiser"""
    optimizer: Optimizer = "rmsprop"
    """rmsprop (α 0.99) or adam; ε is 1e-5"""
    n_epochs: Count = 1
    """times each row is used in an update; V-trace is computed anew each time"""
    minibatches: Count = 1
    """gradient steps of an epoch, each on its own share of the rows"""
    vtrace_lambda: Share = 1.0
    """λ of V-trace: 1 is the paper's, 0 one step"""
    rho_bar: Positive = 1.0
    """importance weights of rewards are clipped to this: infinity would fit the values of the newest policy"""
    c_bar: Positive = 1.0
    """importance weights of traces are clipped to this: how far back a surprise is told"""


class REINFORCEConfig(ActorCriticHyperparameters, frozen=True):
    """Monte-Carlo policy gradient on whole episodes."""

    rollout_steps: Count = 1001
    """T, steps of each env copy in a rollout: more than an episode can have"""
    learning_rate: Positive = 2e-3
    """step size of the optimiser"""
    normalize_rewards: bool = True
    """divide rewards by the running standard deviation of the discounted return; else the baseline drowns the gradient"""
    optimizer: Optimizer = "adam"
    """rmsprop (α 0.99) or adam; ε is 1e-5"""
    baseline: bool = True
    """subtract the critic's value from the return"""
    normalize_returns: bool = True
    """returns, less the baseline, get mean 0 and standard deviation 1 over the batch"""


class DQNConfig(Hyperparameters, frozen=True):
    """Deep Q-learning."""

    rollout_steps: Count = 32
    """T, steps of each env copy in a rollout"""
    activation: Literal["tanh", "relu"] = "relu"
    """of the hidden layers"""
    learning_rate: Positive = 3e-4
    """step size of the optimiser"""
    learning_rate_schedule: Schedule = "constant"
    """linear: falls to zero over the run"""
    optimizer: Literal["adam", "adamw"] = "adam"
    """adamw: also lets weights decay, by 0.01 of the learning rate"""
    amsgrad: bool = False
    """divide by the largest second moment so far instead of the present one"""
    batch_size: Count = 64
    """transitions of a gradient step"""
    gradient_steps: Count = 64
    """gradient steps of an update, that is for envs x rollout_steps env steps: the replay ratio, however many the workers"""
    learning_starts: Annotated[int, msgspec.Meta(ge=0)] = 1000
    """env steps before the first gradient step"""
    replay_size: Count = 100_000
    """transitions kept, the newest (the final observation of a truncated episode takes the place of one)"""
    replay: Literal["uniform", "prioritized"] = "uniform"
    """prioritized: transitions are drawn by the size of their last error"""
    priority_alpha: Share = 0.6
    """how much priorities count: 0 is uniform, 1 in proportion to the error"""
    priority_beta: Share = 0.4
    """how far losses are weighted against what priorities distort; grows to 1, all of it, over the run"""
    n_step: Count = 1
    """steps of reward before the target bootstraps"""
    double: bool = True
    """the network chooses the next action, the target network values it"""
    dueling: bool = False
    """action values are a state's value and each action's advantage over the mean"""
    target: Literal["polyak", "hard"] = "hard"
    """the target network follows a little at each gradient step, or is a copy made now and then"""
    tau: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.005
    """how far a polyak target follows at each gradient step"""
    target_every: Count = 250
    """gradient steps between two copies of a hard target"""
    epsilon_start: Share = 1.0
    """chance of a random action at first"""
    epsilon_end: Share = 0.05
    """and at last"""
    epsilon_schedule: Literal["linear", "exponential"] = "linear"
    """how it falls: straight, or by the same share in every step"""
    epsilon_steps: Count = 10_000
    """env steps, all copies together, until it has fallen (exponential: until the distance has fallen to 1/e)"""
    loss: Literal["huber", "squared"] = "huber"
    """of the error of an action value; huber is linear beyond 1"""
    max_grad_norm: Positive | None = None
    """longer gradients are shortened to this; none: as they are"""
    max_grad_value: Positive | None = None
    """larger entries of a gradient are cut to this, before it is shortened; none: as they are"""


HYPERPARAMETERS: dict[str, type[Hyperparameters]] = {
    "ppo": PPOConfig,
    "a2c": A2CConfig,
    "dqn": DQNConfig,
    "impala": ImpalaConfig,
    "reinforce": REINFORCEConfig,
}


def algorithms_with(name: str) -> str:
    """`; it is one of ALGORITHMS alone` if these algorithms have a setting of this name, else an empty string."""
    owners = [algo for algo, record in HYPERPARAMETERS.items() if name in record.__struct_fields__]
    return f"; it is one of {', '.join(owners)} alone" if owners else ""
