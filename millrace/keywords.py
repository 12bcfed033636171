"""The keywords of `train`, `RolloutService`, `evaluate` and `record`, for editors and type checkers.

Made of the records that hold these settings and flags: `python -m tests.millrace.test_keywords` writes this file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Literal, TypedDict


class RolloutKeywords(TypedDict, total=False):
    """Keywords of `millrace.RolloutService`."""

    env_kwargs: Mapping[str, bool | int | float | str]
    """Keyword arguments for gymnasium.make: NAME VALUE NAME VALUE ... Values are numbers, true, false or text. In text,
    each env copy's number, slot, lane and copy can be used, as in port "{5000 + slot}".
    """
    eval_env_kwargs: Mapping[str, bool | int | float | str]
    """Additional keyword arguments for evaluation copies. They override arguments of the same name in env_kwargs."""
    seat_id: bool
    """In a multi-agent environment, add the number of the agent's seat to its observations."""
    critic_keys: Sequence[str]
    """Keys of a Dict observation that only the critic sees: the policy acts without them (ppo, a2c, impala, reinforce).
    For PettingZoo, the key state is the environment's state().
    """
    seed: int
    """Seed of all the run's random numbers."""
    workers: int | None
    """Number of worker processes on this machine (train only). none: one for each core, but at most one for each lane.
    Use more if env steps wait for something other than the CPU; a run without this setting tells you when they do.
    """
    envs: int
    """Number of env copies, summed over all workers. Must be a multiple of lanes."""
    lanes: int
    """Number of groups of env copies. The copies of a lane are stepped together, on one worker at a time. Lanes are
    distributed over the workers. Results depend on lanes and envs, not on the number of workers.
    """
    max_lag: int
    """Lag of the rollouts: after the first updates, rollouts are collected with weights that are exactly this many
    versions older than the learner's. 0: workers and learner take turns. Above 0: they work at the same time; impala,
    dqn, sac and td3 are designed for this. Runs are reproducible with any lag.
    """
    vector: str
    """How the env copies of a lane are stepped. loop: one after another. native: by the environment's own vector version.
    envpool: by envpool (pip install envpool). native and envpool don't use the same random numbers as loop. Packages
    can add other kinds.
    """
    acting_dtype: Literal["float32", "bfloat16"]
    """Precision in which workers compute actions; the learner always computes in float32. bfloat16 halves the size of the
    weights that are sent. With images, it also halves the time to compute actions on CPUs with AMX; on other CPUs, it
    is slower than float32.
    """
    info_keys: Sequence[str]
    """Names of numbers that the environment reports in info at the end of an episode, such as is_success distance. Their
    means are logged.
    """
    action_masks: Literal["auto", "info", "none"]
    """Where the environment says which Discrete or MultiDiscrete actions are allowed. auto: in the key action_mask of a
    Dict observation, if it has one. info: in info["action_mask"] of each reset and step, unless the Dict observation
    has the key. none: all actions are allowed, and the key is an observation.
    """
    max_env_copies: int
    """Largest number of env copies that the run has on all machines together, for example because of floating licences.
    It includes evaluation copies; evaluations are then played on as few workers as needed. 0: no limit. To limit the
    env copies on one machine, set the environment variable MILLRACE_COPIES_PER_MACHINE.
    """
    min_workers: int
    """Start training when this many workers have joined. 0: wait for all local workers (train) or one worker (learner)."""
    launched_workers: int
    """Number of workers that a launcher starts for this learner (learner only; `millrace launch` sets it). If this many
    different workers report that they can't create the environment, the run ends and prints their reason. 0: wait for
    another worker.
    """
    transport: Literal["inproc", "ipc", "tcp"]
    """How local workers are connected (train only). inproc: as threads of this process, which then also runs the
    environment. ipc: by local sockets. tcp: by TCP on 127.0.0.1.
    """
    bind: str
    """Address at which the learner listens for workers (learner only). With tcp://0.0.0.0:5555, workers on other machines
    can join; this needs keys.
    """
    advertise: str
    """Host name or IP address of this machine for workers on other machines (learner only). Default: the name of this
    machine.
    """
    keys: str | PathLike[str]
    """Key folder. Default: MILLRACE_KEYS, else ~/.config/millrace/keys. TCP connections on this machine need keys too if
    a folder is named here or in MILLRACE_KEYS, or if workers must call a function or class that the run names, such as
    an encoder or a wrapper.
    """
    insecure: bool
    """Accept workers on other machines without keys. Anyone who can reach the port can then read, disturb and stop the
    run.
    """
    metrics_bind: str
    """HOST:PORT at which Prometheus can read the metrics, such as 127.0.0.1:9464 (pip install prometheus-client). With
    0.0.0.0:9464, anyone on the network can read them. Default: no metrics are served.
    """
    dashboard: bool
    """Show the run in a browser while it trains. This machine serves the page, and the learner prints its address."""
    worker_timeout_s: float
    """A worker that has been silent for this many seconds counts as lost, and other workers take over its lanes. A worker
    doesn't count as silent while its supervisor reports that the environment, or your policy, is busy, however long
    that takes.
    """
    lost_lanes: Literal["continue", "restart"]
    """What happens to running episodes when their worker is lost, when lanes move to another worker, and when the run is
    resumed. continue: each episode is replayed on another env copy from its beginning, with the same seed and actions,
    and then continues. If the environment is deterministic given its seed, results then don't depend on which workers
    were lost. restart: new episodes begin.
    """
    replay_limit: int
    """Longest episode, in steps, that is replayed so that it can continue. A longer one is replaced by a new episode.
    Replaying an episode takes as long as its steps took, without the time to compute actions.
    """
    restart_episodes: int
    """Number of episodes after which each env copy, including evaluation copies, is closed and created again. Use it for
    simulators that need more memory or slow down the longer they run. The new copy continues with the seed and the
    random numbers of the old one, and with its saved state if the environment has save_state. If the environment is
    deterministic given its seed, results don't change. 0: never.
    """
    no_workers_timeout_s: float
    """Write a checkpoint and end the run if there has been no worker for this many seconds. If all workers are local, the
    run ends as soon as none is left.
    """
    start_timeout_s: float
    """A worker process, on any machine, is restarted if it takes longer than this many seconds to create or reset one env
    copy, or to create the policy with everything that it imports. 0: never.
    """
    step_timeout_s: float
    """A worker process, on any machine, is restarted if one step of an env copy, or one call to a policy that you wrote
    (an `OwnPolicy`, an opponent, an encoder), takes longer than this many seconds. 0: never.
    """
    max_env_failures: int
    """How many failures the run survives. A failure is an exception or an unusable result from the environment or an
    `OwnPolicy`. The unexpected end of a worker process counts too, because the environment may have caused it. Either
    of two counts ends the run. In a row: one lane has more failures than this, or more than 10, without a rollout in
    between; a failure after env steps counts as a quarter. Within an hour: there are more failures after env steps
    than this × (1 + env copies × h + w / 30). Here h is the number of hours since the learner began, at most 1, and w
    is the number of seconds that the failed workers had worked before.
    """


class TrainKeywords(RolloutKeywords, total=False):
    """Keywords of `millrace.train`."""

    algo: Literal["ppo", "a2c", "dqn", "rainbow", "impala", "reinforce", "sac", "td3", "tqc", "crossq", "xqc"] | str | type
    """Learning algorithm: a built-in one, or your own, such as my_module:MyClass. `--algo NAME --help` shows its
    settings.
    """
    steps: int | float
    """Env steps to train for, summed over all env copies. Training ends before an update that would exceed this number."""
    start_from: str | PathLike[str]
    """Start with the policy from this run folder, and its observation and reward statistics, instead of random weights.
    The folder needs only policy.json and policy.safetensors. All other settings are those of the new run, and
    schedules start from the beginning. A resumed run doesn't read the folder again: see docs/how-to/resume.md.
    """
    from_parts: Literal["auto", "policy", "best", "critic", "all"]
    """What `--from` loads. policy: the newest policy and the statistics. best: the policy with the best evaluation.
    critic: also the critic, the target networks and the temperature. all: also the optimizers. The replay buffer is
    never loaded. auto: critic for sac and the other algorithms for continuous actions with a replay buffer, because
    their actors follow the critic from the first update on; policy for all others, and if that run has no checkpoint.
    """
    device: Literal["auto", "cpu", "cuda"]
    """Device of the learner. auto: cuda if PyTorch finds a GPU, else cpu."""
    run_dir: str | PathLike[str]
    """Folder in which the run folder is created."""
    eval_episodes: int | None
    """Number of greedy episodes in an evaluation. none: 100. If eval_every is 0 and 100 episodes could take more than
    three quarters as many env steps as training, the final evaluation has fewer, but at least 10.
    """
    eval_every: int | float
    """Env steps between evaluations during training. 0: evaluate only at the end."""
    eval_workers: int
    """Number of workers that only evaluate, so that training continues during evaluations. `millrace train` starts them
    in addition to the other workers; `millrace learner` waits for none and uses those that `millrace worker
    --evaluate` starts. The result of an evaluation is used when the next one is due, or at the end of training; the
    learner waits for it then. If no evaluation worker is left by then, the other workers play the episodes. 0: all
    workers evaluate, and training waits.
    """
    eval_copies: int
    """Number of evaluation episodes that a worker plays at the same time, each on its own env copy. This number may
    change the last bits of results. The number of workers doesn't change them.
    """
    eval_max_steps: int | float
    """Largest number of env steps in one evaluation. Each episode gets an equal share. With the default and 100 episodes,
    an episode is cut after 10,000 steps. Its return up to that step counts, and the result says how many episodes were
    cut.
    """
    target_return: float | None
    """Stop as soon as the mean return of an evaluation is at least this. Needs eval_every."""
    target_mean_return: float | None
    """Stop as soon as the mean return of the last 100 training episodes is at least this. A run with fewer than 100
    episodes never stops because of this setting.
    """
    self_play: int
    """Self-play in a multi-agent environment: the policy plays one team, and opponents play the others. The opponents are
    drawn from this many of the policy's newest snapshots. 0: the policy plays all agents, or only against your own
    opponents.
    """
    self_play_save_steps: int
    """Env steps between two snapshots."""
    self_play_latest: float
    """Share of the rollouts in which the policy plays against its newest version instead of a snapshot."""
    opponents: Sequence[str]
    """Your own opponents. They are drawn like the snapshots, and evaluations are played against them. Without self_play,
    the policy plays only against them. docs/how-to/self_play.md shows what the factory returns.
    """
    teams: Sequence[str]
    """One pattern for each team, which matches the names of its agents, as in "red_*" "blue_*". All teams must have the
    same size. Default: each agent is a team of its own. The policy plays different teams in different env copies.
    """
    inference: Literal["workers", "learner"]
    """Where the policy computes actions. workers: in each worker. learner: in a thread of the learner's process, for half
    of the env copies while the other half steps; workers then only step the environments.
    """
    torch_threads: int | None
    """Number of PyTorch threads in the learner. none: chosen when the run starts, and kept in its config.toml. The choice
    is 1. With images, an encoder or a layer of at least 512 x 512 weights, it is instead one for every 34 million
    multiply-adds in a minibatch's forward pass, but at most one for each core. If max_lag is above 0, one core is left
    to each local worker, unless the learner would then get half of the cores or fewer. With shards, the choice is
    always 1. Another number changes the last bits of results.
    """
    shards: int
    """Number of parts of a batch whose gradients are computed separately, so that several learner processes can share the
    work (ppo, a2c, impala, reinforce). It must divide lanes. torchrun starts the processes. Their number must divide
    the number of shards, and doesn't change the results. See docs/how-to/shards.md.
    """
    shard_timeout_s: float
    """Seconds that a learner process waits for the others in an update, or for rank 0 between updates, such as during a
    callback. After that, all of them end with exit code 75.
    """
    insecure_shards: bool
    """Let the learner processes of a run with shards connect over a network, without keys and without encryption. Anyone
    who can reach their ports can then read, disturb and stop the run.
    """
    grace_s: float
    """Seconds from SIGTERM, SIGHUP or Ctrl-C to the end of the process. The current update gets at most half of this
    time; if it takes longer, it is undone, and the state before it is saved. 0: wait for the update, however long it
    takes.
    """
    checkpoint_every_s: float
    """Seconds between checkpoints. A checkpoint is also written after the first update and before each evaluation. 0:
    after each update.
    """
    keep_checkpoints: int
    """Number of newest checkpoints to keep."""
    tensorboard: bool
    """Also write the metrics as TensorBoard events, to the folder tensorboard in the run folder (pip install
    tensorboard).
    """
    record: str
    """Write all complete training episodes to the Minari dataset with this id, such as cartpole/ppo-v0 (pip install
    'minari[hdf5]' pillow). A resumed run writes another dataset, with the next free version.
    """
    prior: str
    """Id of a Minari dataset to learn from as well, such as cartpole/ppo-v0 (pip install 'minari[hdf5]' pillow). With
    clone_epochs, the run begins with a policy that imitates the dataset. Algorithms with a replay buffer draw a share
    of each minibatch, set by prior_share, from the dataset.
    """
    rollout_steps: int
    """ppo, a2c, dqn, rainbow, impala, sac, td3, tqc, crossq, xqc: T, the number of steps of each env copy in a rollout.
    reinforce: T, the number of steps of each env copy in a rollout. Must be larger than the length of any episode.
    """
    net: Sequence[int]
    """ppo, a2c, dqn, impala, reinforce: Sizes of the hidden layers of the actor, and likewise of the critic; or of the
    Q-network.
    rainbow: Sizes of the hidden layers of the Q-network.
    sac, td3, tqc: Sizes of the hidden layers of the actor and of each critic.
    crossq, xqc: Sizes of the hidden layers of the actor.
    """
    activation: Literal["tanh", "relu"]
    """Activation function of the hidden layers."""
    encoder: str | None
    """A torch module of your own in front of the hidden layers, such as my_package.networks:factory. See
    protocol/policy/own_encoder.py.
    """
    normalize_observations: bool
    """ppo: Normalize observations, except images: subtract the running mean, divide by the running standard deviation,
    clip to ±10. docs/how-to/algorithms.md shows why PPO does this by default.
    a2c, dqn, rainbow, impala, reinforce, sac, td3, tqc, crossq, xqc: Normalize observations, except images: subtract
    the running mean, divide by the running standard deviation, clip to ±10.
    """
    gamma: float
    """Discount factor."""
    shared_net: bool
    """ppo, a2c, impala, reinforce: Let actor and critic share their hidden layers."""
    learning_rate: float
    """ppo, a2c, dqn, rainbow, impala, reinforce, sac, tqc, xqc: Learning rate of the optimizer.
    td3, crossq: Learning rate of the optimizers.
    """
    learning_rate_schedule: Literal["constant", "linear"]
    """linear: the learning rate falls to zero over the run."""
    optimizer: Literal["rmsprop", "adam", "adamw"]
    """ppo, a2c, impala, reinforce: Optimizer: rmsprop (α = 0.99) or adam, each with ε = 1e-5.
    dqn, rainbow: Optimizer. adamw: Adam with a decoupled weight decay of 0.01.
    """
    ent_coef: float | None
    """ppo, a2c, impala, reinforce: Weight of the entropy bonus in the loss.
    sac, tqc, crossq, xqc: Temperature α: the weight of the entropy. none: α is learned so that the entropy stays near
    target_entropy.
    """
    ent_coef_schedule: Literal["constant", "linear"]
    """ppo, a2c, impala, reinforce: linear: ent_coef falls to zero over the run."""
    vf_coef: float
    """ppo, a2c, impala, reinforce: Weight of the value loss in the total loss."""
    max_grad_norm: float | None
    """ppo, a2c, impala, reinforce: Clip the norm of the gradient to this.
    dqn, rainbow: Clip the norm of the gradient to this. none: no clipping.
    """
    log_std_init: float
    """ppo, a2c, impala, reinforce: Initial logarithm of the standard deviation of continuous (Box) actions."""
    normalize_rewards: bool
    """ppo, a2c, impala: Divide rewards by the running standard deviation of the discounted return, and clip them to ±10.
    dqn, rainbow, sac, td3, tqc, crossq: When rewards are drawn from the buffer, divide them by the running standard
    deviation of the discounted return, and clip them to ±10. With n_step, the sum of n rewards is clipped.
    reinforce: Divide rewards by the running standard deviation of the discounted return, and clip them to ±10. Without
    this, the baseline's loss dominates the gradient.
    xqc: Divide rewards by the running standard deviation of the discounted return, or by more if necessary, so that
    neither the discounted return so far nor the value of continuing after a truncated episode exceeds return_bound.
    """
    clone_epochs: int
    """ppo, a2c, impala, reinforce: Number of epochs of cloning on the --prior dataset, before the first rollouts are
    collected: the actor learns the dataset's actions, the critic its returns. Needs --prior.
    sac, td3, tqc, crossq, xqc: Number of epochs of cloning on the --prior dataset, before prior_steps and the first
    rollouts: the actor learns the dataset's actions. Needs --prior.
    """
    core: Literal["lstm", "gru"] | None
    """ppo, a2c, impala: Recurrent layer in front of the hidden layers. Minibatches then consist of whole sequences: all T
    steps of some env copies.
    dqn, sac, td3, tqc, crossq, xqc: Recurrent layer in front of the hidden layers. A gradient step then uses whole
    sequences: the rollout_steps steps of an env copy, preceded by the copy's previous rollout as burn-in. Actor and
    critics share the layer, and the critics' loss trains it.
    rainbow: Must be none, because rainbow can't train a recurrent policy. dqn can.
    """
    core_size: int
    """ppo, a2c, dqn, rainbow, impala, sac, td3, tqc, crossq, xqc: Number of units of the recurrent layer."""
    batch_size: int
    """ppo: Largest number of rows (steps of one env copy) in a minibatch. With core, whole sequences may exceed it.
    dqn, rainbow, sac, td3, tqc, crossq, xqc: Number of transitions in a gradient step. With core, as many sequences as
    make up this number, but at least 16.
    """
    n_epochs: int
    """ppo: Number of epochs: how many times an update uses each row.
    impala: Number of epochs: how many times an update uses each row. V-trace is recomputed in each epoch.
    """
    gae_lambda: float
    """ppo, a2c: λ of generalized advantage estimation. 1: Monte Carlo return. 0: one-step TD error."""
    normalize_advantage: bool
    """ppo: Normalize the advantages of each minibatch to mean 0 and standard deviation 1, unless the policy was cloned.
    a2c: Normalize the advantages of each batch to mean 0 and standard deviation 1, unless the policy was cloned.
    """
    clip_range: float
    """ppo: ε of the clipped objective: the ratio of the new to the old action probability is clipped to 1 ± ε."""
    clip_range_schedule: Literal["constant", "linear"]
    """ppo: linear: clip_range falls to zero over the run."""
    clip_range_vf: float | None
    """ppo: Clip each value's change in an update to this, in units of (normalized) reward. none: no clipping."""
    target_kl: float | None
    """ppo: End an update when the KL divergence from the old policy exceeds 1.5 times this. none: never."""
    learning_starts: int | float
    """dqn, rainbow: Number of env steps before the first gradient step.
    sac, td3, tqc, crossq, xqc: Number of env steps before the first gradient step. Until then, actions are drawn
    uniformly.
    """
    replay_size: int | float
    """dqn, rainbow, sac, td3, tqc, crossq, xqc: Capacity of the replay buffer, in transitions; the newest are kept. The
    final observation of a truncated episode takes up the space of one transition.
    """
    priority_alpha: float
    """dqn, sac, td3, tqc, crossq, xqc: α of prioritized replay: how strongly the probability of drawing a transition
    depends on its last TD error. 0: not at all. 1: in proportion. Schaul et al. 2016 use 0.6.
    rainbow: α of prioritized replay: how strongly the probability of drawing a transition depends on its last TD
    error. 0: not at all. 1: in proportion.
    """
    priority_beta: float
    """dqn, rainbow, sac, td3, tqc, crossq, xqc: Initial β of prioritized replay: how much of the bias importance weights
    correct. It grows to 1 (all) over the run.
    """
    prior_share: float
    """dqn, rainbow, sac, td3, tqc, crossq, xqc: Share of each minibatch that is prior data, in a run with --prior (Ball
    et al. 2023 use 0.5).
    """
    prior_steps: int | float
    """dqn, rainbow, sac, td3, tqc, crossq, xqc: Number of gradient steps on only prior data, before the first rollouts
    are collected. Needs --prior.
    """
    hindsight: float
    """dqn, rainbow, sac, td3, tqc, crossq, xqc: Hindsight experience replay: the share of a minibatch's transitions whose
    goal is replaced by a goal that was achieved later in the episode. 0: off. Andrychowicz et al. 2017 use 0.8. Needs
    goal_reward, and observations with achieved_goal and desired_goal.
    """
    goal_reward: str | None
    """dqn, rainbow, sac, td3, tqc, crossq, xqc: How the environment computes rewards from achieved and desired goals, for
    hindsight. sparse:0.05: 0 within this distance of the goal, else -1. success:0.45: 1 within this distance, else 0.
    dense: minus the distance. Or your own function, such as my_module:reward, which takes two arrays [B, G] and
    returns an array [B].
    """
    goal_ends: float | None
    """dqn, rainbow, sac, td3, tqc, crossq, xqc: The distance from the goal at which an episode terminates, for hindsight.
    none: reaching the goal doesn't end it.
    """
    n_step: int
    """dqn, rainbow, sac, td3, tqc, crossq, xqc: Number of rewards in a target before it bootstraps. With several agents,
    each agent's own steps count.
    """
    tau: float
    """dqn: Fraction by which each update of the target network moves it toward the network. 1: it becomes a copy. With a
    small fraction, such as 0.005, set target_every to 1 (polyak averaging).
    rainbow: Fraction by which each update of the target network moves it toward the network.
    sac, td3, tqc, crossq, xqc: τ of the polyak update: the fraction by which each gradient step moves the target
    network toward the network.
    """
    amsgrad: bool
    """dqn, rainbow: Use the AMSGrad variant of the optimizer."""
    gradient_steps: int
    """dqn, rainbow: Number of gradient steps in an update. There is one update for every envs x rollout_steps env steps,
    so this setting determines the replay ratio.
    """
    double: bool
    """dqn, rainbow: Double Q-learning: the network chooses the next action, and the target network evaluates it."""
    dueling: bool
    """dqn, rainbow: Dueling network: an action value is the value of the state plus the action's advantage minus the mean
    advantage.
    """
    target_every: int
    """dqn, rainbow: Number of gradient steps between two updates of the target network."""
    epsilon_start: float
    """dqn, rainbow: Initial probability ε of a random action."""
    epsilon_end: float
    """dqn, rainbow: Final probability ε of a random action."""
    epsilon_schedule: Literal["linear", "exponential"]
    """dqn, rainbow: How ε falls from its initial to its final value."""
    epsilon_steps: int | float
    """dqn, rainbow: Number of env steps, summed over all env copies, over which ε falls. With exponential, the number of
    env steps after which the difference between ε and its final value has fallen to 1/e of what it was.
    """
    max_grad_value: float | None
    """dqn, rainbow: Clip each entry of the gradient to ± this value, before the gradient's norm is clipped. none: no
    clipping.
    """
    loss: Literal["huber", "squared"]
    """dqn: Loss function of the TD error. huber: squared up to 1 and linear beyond."""
    quantiles: int
    """rainbow: Number of quantiles of the return that are learned for each action.
    tqc: Number of quantiles that each critic learns.
    """
    batch_norm: bool
    """rainbow: Use batch normalization on the inputs and before each activation of the hidden layers (Bhatt et al. 2024)."""
    minibatches: int
    """impala: Number of minibatches (gradient steps) in an epoch."""
    vtrace_lambda: float
    """impala: λ of V-trace. 1: as in the paper. 0: one step."""
    rho_bar: float
    """impala: ρ̄ of V-trace: importance weights of TD errors are clipped to this. The larger ρ̄ is, the closer the
    learned values are to the newest policy's values; without clipping, they are the same.
    """
    c_bar: float
    """impala: c̄ of V-trace: importance weights of traces are clipped to this. It determines how far back the effect of a
    TD error reaches.
    """
    baseline: bool
    """reinforce: Subtract the critic's value estimate from the return."""
    normalize_returns: bool
    """reinforce: Normalize the returns of each batch (minus the baseline) to mean 0 and standard deviation 1."""
    updates_per_step: float
    """sac, td3, tqc, crossq, xqc: Replay ratio: gradient steps per env step after learning_starts. It is exact for any
    size of rollouts.
    """
    random_shift: int
    """sac, td3, tqc, crossq, xqc: Largest random shift, in pixels, of an image each time it is in a minibatch (DrQ-v2).
    It has no effect on observations without images.
    """
    target_entropy: float | None
    """sac, tqc, crossq, xqc: The entropy that a learned temperature aims for. none: minus the dimension of the action."""
    exploration_noise: float
    """td3: Standard deviation of the noise that workers add to actions, which are in [-1, 1]."""
    policy_delay: int
    """td3: Number of the critics' gradient steps for each step of the actor and the target networks.
    crossq, xqc: Number of the critics' gradient steps for each step of the actor and the temperature.
    """
    target_noise: float
    """td3: Standard deviation of the noise that is added to the target actor's actions."""
    target_noise_clip: float
    """td3: Clip target_noise to ± this value."""
    critics: int
    """tqc: Number of critics."""
    dropped_quantiles: int
    """tqc: Number of each critic's highest quantiles that are left out of targets, so that values are not overestimated."""
    critic_net: Sequence[int]
    """crossq, xqc: Sizes of the hidden layers of each critic."""
    renormalize_after: int
    """crossq: Number of gradient steps after which batch normalization becomes batch renormalization."""
    atoms: int
    """xqc: Number of returns, equally spaced from -return_bound to return_bound, whose probabilities a critic learns."""
    return_bound: float
    """xqc: Largest absolute return, in units of scaled reward, that a critic can learn."""


class PlayKeywords(TypedDict, total=False):
    """Keywords of `millrace.evaluate` and `millrace.record`."""

    best: bool
    """use the policy with the best evaluation during the run (--eval-every) instead of the newest policy"""
    workers: int | None
    """number of worker processes that play the episodes; the result does not depend on it. If not given: 2, or 1 if the
    run's --max-env-copies allows only one worker's copies
    """
    transport: Literal["inproc", "ipc", "tcp"]
    """how local workers are connected: as threads of this process, by local sockets, or by TCP"""
    bind: str
    """address at which workers from elsewhere can join, such as tcp://0.0.0.0:5555; no workers are then started here"""
    inference: Literal["workers", "learner"]
    """where the policy acts: in each worker, or in this process; workers that only step the environment require learner"""
    max_env_failures: int
    """give up after more failures than this; an exception in the environment or a killed worker process is a failure"""


class EvaluateKeywords(PlayKeywords, total=False):
    """Keywords of `millrace.evaluate`."""

    against: str | PathLike[str] | None
    """run folder of a policy that plays the other teams; both sample their actions, and each team is played in turn"""
    seed: int
    """seed of the episodes"""
    copies: int | None
    """number of episodes that a worker plays at the same time; if not given: the run's --eval-copies, but at most its
    --max-env-copies
    """
    max_steps: int
    """limit on the env steps of all episodes together; each episode gets an equal share, and is cut when it is used up"""
    video: bool
    """record each episode as an mp4 file in the run's folder videos (pip install moviepy pygame-ce)"""


class RecordKeywords(PlayKeywords, total=False):
    """Keywords of `millrace.record`."""

    npy: str | PathLike[str] | None
    """also write this .npy file: a float32 array with a row [observation, action], flattened, for each step"""
    stochastic: bool
    """sample actions from the policy, as in training, instead of taking the most probable ones"""
    seed: int
    """seed of the episodes and of the sampled actions"""
