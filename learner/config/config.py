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
from learner.config.settings import CheckpointPolicy, EvaluationSettings, StopRule
from protocol.specs import ImagesDtype
from protocol.wire.weight_dtypes import WeightsDtype

PRESETS = Path(__file__).with_name("presets.toml")
Scalar = bool | int | float | str
Count = Annotated[int, Meta(ge=1)]
Natural = Annotated[int, Meta(ge=0)]
Seconds = Annotated[float, Meta(gt=0)]


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that decides how a run goes."""

    env: Positional[str] = ""
    """anything gymnasium.make takes: CartPole-v1, ALE/Pong-v5, my_package.envs:MyEnv-v0"""
    env_kwargs: dict[str, Scalar] = {}
    """keyword arguments of gymnasium.make: name value name value …"""
    algo: str = "ppo"
    """the algorithm: one of those in learner/config/hyperparameters.py"""
    algorithm: Hyperparameters = PPOConfig()
    """the algorithm's own settings"""

    steps: Count = 100_000
    """env steps to train for, all copies together: it ends when one more update would pass them"""
    seed: Natural = 1
    """everything random follows from it"""
    workers: Count = 2
    """worker processes on this machine"""
    envs: Count = 8
    """env copies, all workers together; a multiple of lanes"""
    lanes: Count = 4
    """groups into which the env copies are divided; workers share out the lanes, and results do not depend on the workers"""
    max_lag: Natural = 0
    """how many versions old the weights behind a rollout may be; 0 is synchronous"""
    vector: Literal["auto", "loop", "native", "envpool"] = "auto"
    """how a lane's env copies are stepped: one after another (loop), or at once by the environment's own vectorised form
    (native) or by envpool's (pip install 'millrace-rl[envpool]'), with other random numbers; auto is loop, wherever it runs
    """

    inference: Literal["workers", "learner"] = "workers"
    """where the policy acts: in each worker, or beside the learner, for all env copies at once, so that workers only step"""

    transport: Literal["inproc", "ipc", "tcp"] = "ipc"
    """how local workers are reached: threads of this process, local sockets, or loopback TCP"""
    compress: Literal["none", "zstd"] = "none"
    """how workers compress their rollouts: not at all, or by Zstandard, which pays for images, on almost any network
    (pip install 'millrace-rl[compress]', here and with every worker)
    """
    weights_dtype: WeightsDtype = "float32"
    """as what weights travel to workers: rounded, as bfloat16 or float16, they are half as many bytes. Workers act under the
    rounded ones, of which their log-probabilities are; the learner's own stay float32
    """
    images_dtype: ImagesDtype = "float32"
    """as what the acting policy looks at images; in bfloat16 half the work on a CPU with matrix units (AMX), more on one
    without. Log-probabilities are those of the actions as they were drawn; the learner's own stay float32
    """
    bind: str = "tcp://127.0.0.1:5555"
    """where `millrace learner` listens for workers; tcp://0.0.0.0:5555 is for other machines, and needs keys"""
    advertise: str = ""
    """the host that workers on other machines are told; if not given, this machine's name"""
    keys: str = ""
    """folder of keys (or MILLRACE_KEYS): then loopback TCP needs keys too; if not given, ~/.config/millrace/keys"""
    insecure: bool = False
    """let other machines connect without keys: whoever reaches the port can read the run, spoil it and stop it"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where the learner learns"""
    torch_threads: Count | None = None
    """threads of PyTorch in the learner; none: 1 for a small MLP, else as many as there are cores that no worker needs
    meanwhile (with max_lag 0 all). Their number changes results in the last bits
    """
    run_dir: str = "runs"
    """where run folders go"""

    eval_episodes: Count = 100
    """greedy episodes of an evaluation"""
    eval_every: Natural = 0
    """env steps between greedy evaluations while training; 0: only the one at the end"""
    target_return: float | None = None
    """stop as soon as a greedy evaluation averages at least this"""
    target_mean_return: float | None = None
    """stop as soon as the last 100 training episodes average at least this"""
    checkpoint_every_s: Seconds = 60.0
    """seconds between checkpoints"""
    checkpoint_every_episodes: Natural = 0
    """episodes between checkpoints, besides those by time; 0: by time alone"""
    checkpoint_every_updates: Natural = 0
    """updates between checkpoints, besides those by time; 0: by time alone"""
    keep_checkpoints: Count = 3
    """how many of the newest checkpoints stay"""

    metrics_bind: str = ""
    """where Prometheus finds the metrics, as 127.0.0.1:9464; 0.0.0.0:9464 lets everybody read them; if not given, nowhere"""

    record: str = ""
    """id of a Minari dataset of every whole training episode, as cartpole/ppo-v0 (pip install 'millrace-rl[record]')"""

    min_workers: Natural = 0
    """start when so many workers have joined; 0: all local workers, or the first one"""
    heartbeat_s: Seconds = 1.0
    """seconds between a worker's accounts of itself"""
    worker_timeout_s: Seconds = 5.0
    """a worker silent for so many seconds is given up, and its lanes go elsewhere"""
    no_workers_timeout_s: Seconds = 60.0
    """end the run, after a checkpoint, when no worker has been here for so many seconds"""
    step_timeout_s: Seconds = 120.0
    """a local worker process that takes so many seconds for a step of one env copy is ended, and started again"""
    pin_workers: bool | None = None
    """each local worker process keeps to one core; none: it does where workers and learner take turns (max_lag 0) and there
    are as many workers as cores, or twice as many, ..."""
    stall_timeout_s: Seconds = 600.0
    """end the run, after a checkpoint, when nothing has arrived for so many seconds"""
    max_env_failures: Natural = 3
    """end the run when the environment has raised more often than this"""

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
        return EvaluationSettings(episodes=self.eval_episodes, every_env_steps=self.eval_every, seed=self.seed)

    def to_toml(self) -> str:
        """All settings as TOML, in the order of the fields. A setting that is None is written as "none"."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        tables = {"env_kwargs": plain.pop("env_kwargs"), self.algo: _without_none(plain.pop("algorithm"))}
        return tomli_w.dumps(_without_none(plain) | tables)


def _without_none(plain: dict[str, Any]) -> dict[str, Any]:
    return {name: "none" if value is None else value for name, value in plain.items()}
