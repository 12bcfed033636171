"""All settings of a run, in one record. The texts under the fields are also the command line's help. Pure.

This file has the settings for learning. The base class, `RolloutConfig` (learner/config/rollout_config.py), has the settings
for collecting rollouts: the environment, workers, env copies, lanes, timeouts and the transport. learner/config/layers.py
merges a run's settings from presets, files and flags. `GROUPS` in learner/config/command_line.py lists the groups that
`--help` shows.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tomli_w
from msgspec import Meta

from millrace.flags.fields import Flag, NotNegative, Positive
from millrace.learner.config.hyperparameters import HYPERPARAMETERS, AlgorithmConfig, PPOConfig
from millrace.learner.config.resume_rules import Fixed, Free
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.protocol.bounds import MAX_SEEDS, Count, Natural

TABLES = ("env_kwargs", "eval_env_kwargs")  # settings that are tables, which layers merge key by key
PRESETS = Path(__file__).with_name("presets.toml")


class Config(RolloutConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All settings of a run: how rollouts are collected, and how it learns from them."""

    # ------------------------------------------------------------------------------------------------------------ basics

    algo: Annotated[Fixed[str], Flag(f"{{{','.join(HYPERPARAMETERS)}}}|MODULE:CLASS")] = "ppo"
    """Learning algorithm: a built-in one, or your own, such as my_module:MyClass. `--algo NAME --help` shows its
    settings.
    """
    algorithm: Fixed[AlgorithmConfig] = PPOConfig()
    """Settings of the algorithm."""
    steps: Free[Count] = 100_000
    """Env steps to train for, summed over all env copies. Training ends before an update that would exceed this number."""
    start_from: Annotated[Fixed[str], Flag("PATH", alias="from")] = ""
    """Start with the policy from this run folder, and its observation and reward statistics, instead of random weights. The
    folder needs only policy.json and policy.safetensors. All other settings are those of the new run, and schedules start
    from the beginning. A resumed run doesn't read the folder again: see docs/how-to/resume.md.
    """
    from_parts: Fixed[Literal["auto", "policy", "best", "critic", "all"]] = "auto"
    """What `--from` loads. policy: the newest policy and the statistics. best: the policy with the best evaluation. critic:
    also the critic, the target networks and the temperature. all: also the optimizers. The replay buffer is never loaded.
    auto: critic for sac and the other algorithms for continuous actions with a replay buffer, because their actors follow
    the critic from the first update on; policy for all others, and if that run has no checkpoint.
    """
    device: Free[Literal["auto", "cpu", "cuda"]] = "auto"
    """Device of the learner. auto: cuda if PyTorch finds a GPU, else cpu."""
    run_dir: Free[str] = "runs"
    """Folder in which the run folder is created."""

    # -------------------------------------------------------------------------------------------- evaluation and targets

    eval_episodes: Free[Count | None] = None
    """Number of greedy episodes in an evaluation. none: 100. If eval_every is 0 and 100 episodes could take more than three
    quarters as many env steps as training, the final evaluation has fewer, but at least 10.
    """
    eval_every: Free[Natural] = 0
    """Env steps between evaluations during training. 0: evaluate only at the end."""
    eval_workers: Free[Natural] = 0
    """Number of workers that only evaluate, so that training continues during evaluations. `millrace train` starts them in
    addition to the other workers; `millrace learner` waits for none and uses those that `millrace worker --evaluate` starts.
    The result of an evaluation is used when the next one is due, or at the end of training; the learner waits for it then.
    If no evaluation worker is left by then, the other workers play the episodes. 0: all workers evaluate, and training
    waits.
    """
    eval_copies: Free[Annotated[int, Meta(ge=1, le=MAX_SEEDS)]] = 4
    """Number of evaluation episodes that a worker plays at the same time, each on its own env copy. This number may change
    the last bits of results. The number of workers doesn't change them.
    """
    eval_max_steps: Free[Count] = 1_000_000
    """Largest number of env steps in one evaluation. Each episode gets an equal share. With the default and 100 episodes, an
    episode is cut after 10,000 steps. Its return up to that step counts, and the result says how many episodes were cut.
    """
    target_return: Free[float | None] = None
    """Stop as soon as the mean return of an evaluation is at least this. Needs eval_every."""
    target_mean_return: Free[float | None] = None
    """Stop as soon as the mean return of the last 100 training episodes is at least this. A run with fewer than 100 episodes
    never stops because of this setting.
    """

    # ---------------------------------------------------------------------------------------------------------- self-play

    self_play: Fixed[Natural] = 0
    """Self-play in a multi-agent environment: the policy plays one team, and opponents play the others. The opponents are
    drawn from this many of the policy's newest snapshots. 0: the policy plays all agents, or only against your own
    opponents.
    """
    self_play_save_steps: Free[Count] = 20_000
    """Env steps between two snapshots."""
    self_play_latest: Free[Annotated[float, Meta(ge=0, le=1)]] = 0.5
    """Share of the rollouts in which the policy plays against its newest version instead of a snapshot."""
    opponents: Annotated[Fixed[tuple[str, ...]], Flag("MODULE:FACTORY ...")] = ()
    """Your own opponents. They are drawn like the snapshots, and evaluations are played against them. Without self_play, the
    policy plays only against them. docs/how-to/self_play.md shows what the factory returns.
    """
    teams: Annotated[Fixed[tuple[str, ...]], Flag("PATTERN ...")] = ()
    """One pattern for each team, which matches the names of its agents, as in "red_*" "blue_*". All teams must have the same
    size. Default: each agent is a team of its own. The policy plays different teams in different env copies.
    """

    # ---------------------------------------------------------------------------------------------- the learner's process

    inference: Free[Literal["workers", "learner"]] = "workers"
    """Where the policy computes actions. workers: in each worker. learner: in a thread of the learner's process, for half of
    the env copies while the other half steps; workers then only step the environments.
    """
    torch_threads: Free[Count | None] = None
    """Number of PyTorch threads in the learner. none: chosen when the run starts, and kept in its config.toml. The choice is
    1. With images, an encoder or a layer of at least 512 x 512 weights, it is instead one for every 34 million multiply-adds
    in a minibatch's forward pass, but at most one for each core. If max_lag is above 0, one core is left to each local
    worker, unless the learner would then get half of the cores or fewer. With shards, the choice is always 1. Another number
    changes the last bits of results.
    """

    shards: Fixed[Count] = 1
    """Number of parts of a batch whose gradients are computed separately, so that several learner processes can share the
    work (ppo, a2c, impala, reinforce). It must divide lanes. torchrun starts the processes. Their number must divide the
    number of shards, and doesn't change the results. See docs/how-to/shards.md.
    """
    shard_timeout_s: Free[Positive] = 600.0
    """Seconds that a learner process waits for the others in an update, or for rank 0 between updates, such as during a
    callback. After that, all of them end with exit code 75.
    """
    insecure_shards: Free[bool] = False
    """Let the learner processes of a run with shards connect over a network, without keys and without encryption. Anyone who
    can reach their ports can then read, disturb and stop the run.
    """

    grace_s: Free[NotNegative] = 30.0
    """Seconds from SIGTERM, SIGHUP or Ctrl-C to the end of the process. The current update gets at most half of this time;
    if it takes longer, it is undone, and the state before it is saved. 0: wait for the update, however long it takes.
    """

    callbacks: Annotated[Free[tuple[str, ...]], Flag("MODULE:FACTORY ...")] = ()
    """Your own callbacks, such as my_module:factory. The learner calls them between updates.
    docs/how-to/callbacks.md describes them.
    """

    # -------------------------------------------------------------------------------------------------------------- files

    checkpoint_every_s: Free[NotNegative] = 60.0
    """Seconds between checkpoints. A checkpoint is also written after the first update and before each evaluation. 0: after
    each update.
    """
    keep_checkpoints: Free[Count] = 3
    """Number of newest checkpoints to keep."""
    tensorboard: Free[bool] = False
    """Also write the metrics as TensorBoard events, to the folder tensorboard in the run folder
    (pip install tensorboard).
    """
    record: Free[str] = ""
    """Write all complete training episodes to the Minari dataset with this id, such as cartpole/ppo-v0
    (pip install 'minari[hdf5]' pillow). A resumed run writes another dataset, with the next free version.
    """

    prior: Fixed[str] = ""
    """Id of a Minari dataset to learn from as well, such as cartpole/ppo-v0 (pip install 'minari[hdf5]' pillow). With
    clone_epochs, the run begins with a policy that imitates the dataset. Algorithms with a replay buffer draw a share of
    each minibatch, set by prior_share, from the dataset.
    """

    def to_toml(self) -> str:
        """All settings as TOML, in the order of the fields. A setting that is None is written as "none"."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        tables = {name: plain.pop(name) for name in TABLES} | {self.algo: _without_none(plain.pop("algorithm"))}
        return tomli_w.dumps(_without_none(plain) | tables)


def _without_none(plain: dict[str, Any]) -> dict[str, Any]:
    return {name: "none" if value is None else value for name, value in plain.items()}
