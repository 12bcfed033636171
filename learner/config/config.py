"""All settings of a run, in one record. The texts under the fields are the help of the command line. Pure.

How the settings of a run are put together from presets, files and flags: learner/config/layers.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tomli_w
from msgspec import Meta
from tyro.conf import Positional

from learner.config.hyperparameters import Hyperparameters, PPOConfig
from learner.config.on_resume import Adaptable, Fixed, Free
from learner.config.run_rules import CheckpointPolicy, EvaluationSettings, StopRule
from protocol.alive import CallTimeouts
from protocol.bounds import MAX_SEEDS
from protocol.specs import ImagesDtype, Vector
from protocol.wire.weight_dtypes import WeightsDtype

PRESETS = Path(__file__).with_name("presets.toml")
Scalar = bool | int | float | str
Count = Annotated[int, Meta(ge=1)]
Natural = Annotated[int, Meta(ge=0)]
Seconds = Annotated[float, Meta(gt=0)]
SecondsOrNever = Annotated[float, Meta(ge=0)]


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All settings of a run."""

    # ------------------------------------------------------------------------------------------------------------ basics

    env: Fixed[Positional[str]] = ""
    """Environment id for gymnasium.make, as CartPole-v1, ALE/Pong-v5 or my_package.envs:MyEnv-v0."""
    env_kwargs: Fixed[dict[str, Scalar]] = {}
    """Keyword arguments for gymnasium.make: NAME VALUE NAME VALUE ..."""
    algo: Fixed[str] = "ppo"
    """Learning algorithm. `--algo NAME --help` shows its settings."""
    algorithm: Fixed[Hyperparameters] = PPOConfig()
    """Settings of the algorithm."""
    steps: Free[Count] = 100_000
    """Env steps to train for, summed over all env copies. Training ends before an update that would exceed them."""
    seed: Fixed[Natural] = 1
    """Seed of all random numbers of the run."""
    workers: Free[Count] = 2
    """Number of worker processes on this machine (train only)."""
    envs: Adaptable[Count] = 8
    """Number of env copies, summed over all workers. Must be a multiple of lanes."""
    device: Free[Literal["auto", "cpu", "cuda"]] = "auto"
    """Device of the learner. auto: cuda if PyTorch finds a GPU, else cpu."""
    run_dir: Free[str] = "runs"
    """Folder in which the run folder is made."""

    # -------------------------------------------------------------------------------------------- evaluation and targets

    eval_episodes: Free[Count] = 100
    """Number of greedy episodes in an evaluation."""
    eval_every: Free[Natural] = 0
    """Env steps between evaluations during training. 0: evaluate only at the end."""
    eval_copies: Free[Annotated[int, Meta(ge=1, le=MAX_SEEDS)]] = 4
    """Number of evaluation episodes that a worker plays side by side, on env copies of their own. The last bits of results
    may depend on it. They do not depend on the number of workers.
    """
    eval_max_steps: Free[Count] = 1_000_000
    """Most env steps of one evaluation. Each episode gets an equal share: with 100 episodes, one that reaches 10000 steps is
    cut. It counts with the return it has by then, and the result says how many were cut.
    """
    target_return: Free[float | None] = None
    """Stop as soon as the mean return of an evaluation is at least this. Needs eval_every."""
    target_mean_return: Free[float | None] = None
    """Stop as soon as the mean return of the last 100 training episodes is at least this."""

    # ------------------------------------------------------------------------------------------------------------ workers

    lanes: Adaptable[Count] = 4
    """Number of groups of env copies. The copies of a lane are stepped together, on one worker at a time. Lanes are
    distributed over the workers. Results depend on lanes and envs, not on the number of workers.
    """
    max_lag: Free[Natural] = 0
    """Largest lag of a rollout: how many versions its weights may be older than the learner's. 0: workers and learner take
    turns, and results are reproducible. Above 0: both run at the same time; impala and dqn are made for that.
    """
    vector: Free[Literal["auto", "loop", "native", "envpool"]] = "auto"
    """How the env copies of a lane are stepped. loop: one after another. native: by the environment's own vector version.
    envpool: by envpool (pip install 'millrace-rl[envpool]'). auto: loop. The others use other random numbers.
    """
    inference: Free[Literal["workers", "learner"]] = "workers"
    """Where the policy acts. workers: in each worker. learner: in one place beside the learner, for all env copies at once;
    workers then only step the environments.
    """
    images_dtype: Free[ImagesDtype] = "float32"
    """Precision in which the acting policy processes images. bfloat16 halves the work on CPUs with AMX and is slower
    elsewhere. The learner always computes in float32.
    """
    torch_threads: Free[Count | None] = None
    """Number of PyTorch threads in the learner. none: chosen when the run starts, and kept in its config.toml: 1;
    or with images, an encoder or a layer of 512 x 512 weights all cores. If max_lag is above 0, one core is left to each
    local worker, unless half of the cores or less would remain. Another number changes the last bits of results.
    """
    pin_workers: Free[bool | None] = None
    """Keep each local worker process on one core (train only). none: do so if max_lag is 0 and the number of workers is a
    multiple of the number of cores.
    """
    min_workers: Free[Natural] = 0
    """Start training when this many workers have joined. 0: wait for all local workers (train), for one worker (learner)."""

    # ------------------------------------------------------------------------------------------------------------ network

    transport: Free[Literal["inproc", "ipc", "tcp"]] = "ipc"
    """How local workers are connected (train only). inproc: as threads of this process, which then runs the environment.
    ipc: local sockets. tcp: TCP on 127.0.0.1.
    """
    bind: Free[str] = "tcp://127.0.0.1:5555"
    """Address at which the learner listens for workers (learner only). With tcp://0.0.0.0:5555 other machines can join; this
    needs keys.
    """
    advertise: Free[str] = ""
    """Host name or IP address at which workers on other machines reach this one (learner only). Default: the name of this
    machine.
    """
    keys: Free[str] = ""
    """Key folder. Default: MILLRACE_KEYS, else ~/.config/millrace/keys. If a folder is named here or in MILLRACE_KEYS, TCP
    connections on this machine need keys too.
    """
    insecure: Free[bool] = False
    """Accept workers of other machines without keys. Whoever reaches the port can then read, disturb and stop the run."""
    compress: Free[Literal["none", "zstd"]] = "none"
    """Compression of rollouts. zstd reduces the size of images, which pays on almost any network
    (pip install 'millrace-rl[compress]' for the learner and every worker).
    """
    weights_dtype: Free[WeightsDtype] = "float32"
    """Precision of the weights that are sent to workers. bfloat16 and float16 halve the bytes. Workers act with the rounded
    weights; the learner's stay float32.
    """

    # ---------------------------------------------------------------------------------------------- timeouts and failures

    heartbeat_s: Free[Seconds] = 1.0
    """Seconds between two heartbeats of a worker."""
    worker_timeout_s: Free[Seconds] = 5.0
    """A worker that has been silent for this many seconds is given up, and other workers take over its lanes. A worker is
    not silent while its supervisor says that its environment is busy, however long that takes.
    """
    no_workers_timeout_s: Free[Seconds] = 60.0
    """Write a checkpoint and end the run if there has been no worker for this many seconds."""
    construct_timeout_s: Free[SecondsOrNever] = 600.0
    """A local worker process is restarted if making one env copy takes longer than this many seconds. 0: never."""
    reset_timeout_s: Free[SecondsOrNever] = 600.0
    """A local worker process is restarted if a reset of an env copy takes longer than this many seconds. 0: never."""
    step_timeout_s: Free[SecondsOrNever] = 600.0
    """A local worker process is restarted if one step of an env copy takes longer than this many seconds. 0: never."""
    stall_timeout_s: Free[Seconds] = 600.0
    """Write a checkpoint and end the run if no env step, reset or construction has ended for this many seconds, and none
    is under way within its timeout.
    """
    max_env_failures: Free[Natural] = 3
    """End the run if the environment has raised more exceptions, or ended more worker processes, than this."""

    # -------------------------------------------------------------------------------------------------------------- files

    checkpoint_every_s: Free[Seconds] = 60.0
    """Seconds between checkpoints."""
    checkpoint_every_episodes: Free[Natural] = 0
    """Also write a checkpoint after this many training episodes. 0: do not."""
    checkpoint_every_updates: Free[Natural] = 0
    """Also write a checkpoint after this many updates. 0: do not."""
    keep_checkpoints: Free[Count] = 3
    """Number of checkpoints to keep, the newest ones."""
    record: Free[str] = ""
    """Write all whole training episodes into the Minari dataset of this id, as cartpole/ppo-v0
    (pip install 'millrace-rl[record]').
    """
    metrics_bind: Free[str] = ""
    """HOST:PORT at which Prometheus can read the metrics, as 127.0.0.1:9464. With 0.0.0.0:9464 everybody in the network can
    read them. Default: nowhere.
    """

    def call_timeouts(self) -> CallTimeouts:
        """How long a call of an env copy may take."""
        return CallTimeouts(self.construct_timeout_s, self.reset_timeout_s, self.step_timeout_s)

    def chosen_vector(self) -> Vector:
        """How the env copies of a lane are stepped."""
        return "loop" if self.vector == "auto" else self.vector

    def stop_rule(self) -> StopRule:
        """When training ends."""
        return StopRule(steps=self.steps, target_return=self.target_return, target_mean_return=self.target_mean_return)

    def checkpoint_policy(self) -> CheckpointPolicy:
        """When checkpoints are written, and how many are kept."""
        return CheckpointPolicy(
            every_s=self.checkpoint_every_s,
            every_episodes=self.checkpoint_every_episodes,
            every_updates=self.checkpoint_every_updates,
            keep=self.keep_checkpoints,
        )

    def evaluation_settings(self) -> EvaluationSettings:
        """How often the policy is evaluated, and on which episodes."""
        return EvaluationSettings(
            episodes=self.eval_episodes,
            every_env_steps=self.eval_every,
            copies=self.eval_copies,
            max_steps=self.eval_max_steps,
            seed=self.seed,
        )

    def to_toml(self) -> str:
        """All settings as TOML, in the order of the fields. A setting that is None is written as "none"."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        tables = {"env_kwargs": plain.pop("env_kwargs"), self.algo: _without_none(plain.pop("algorithm"))}
        return tomli_w.dumps(_without_none(plain) | tables)


def _without_none(plain: dict[str, Any]) -> dict[str, Any]:
    return {name: "none" if value is None else value for name, value in plain.items()}
