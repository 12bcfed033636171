"""The flags of `evaluate` and `record`, which are also the keyword arguments of the functions of the same names."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from millrace.flags.fields import Flag
from millrace.protocol.bounds import MAX_SEEDS, Count, Natural


class PlayFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Flags of the commands whose workers play episodes of a run's policy."""

    run: Annotated[Path, Flag(positional=True)]
    """run folder"""
    best: bool = False
    """use the policy with the best evaluation during the run (--eval-every) instead of the newest policy"""
    env: str = ""
    """the environment, if the run can't find it itself, such as my_module:make_env or my_module:MyEnv-v0"""
    wrappers: Annotated[tuple[str, ...], Flag("MODULE:CLASS ...")] = ()
    """the wrappers, innermost first, if the run can't find them itself"""
    workers: Annotated[Count | None, Flag("INT")] = None
    """number of worker processes that play the episodes; the result does not depend on it. If not given: 2, or 1 if the
    run's --max-env-copies allows only one worker's copies
    """
    transport: Literal["inproc", "ipc", "tcp"] = "ipc"
    """how local workers are connected: as threads of this process, by local sockets, or by TCP"""
    bind: str = ""
    """address at which workers from elsewhere can join, such as tcp://0.0.0.0:5555; no workers are then started here"""
    inference: Literal["workers", "learner"] = "workers"
    """where the policy acts: in each worker, or in this process; workers that only step the environment require learner"""
    max_env_failures: Natural = 3
    """give up after more failures than this; an exception in the environment or a killed worker process is a failure"""


class EvaluateFlags(PlayFlags, frozen=True, kw_only=True):
    """Play greedy episodes of a run's newest policy; print mean and standard deviation of the return."""

    episodes: Annotated[Count | None, Flag("INT")] = None
    """number of episodes; if not given: 100, or 3 with --video"""
    against: Annotated[Path | None, Flag("RUN")] = None
    """run folder of a policy that plays the other teams; both sample their actions, and each team is played in turn"""
    seed: Natural = 1_000_000
    """seed of the episodes"""
    copies: Annotated[Annotated[int, Meta(ge=1, le=MAX_SEEDS)] | None, Flag("INT")] = None
    """number of episodes that a worker plays at the same time; if not given: the run's --eval-copies, but at most its
    --max-env-copies
    """
    max_steps: Count = 1_000_000
    """limit on the env steps of all episodes together; each episode gets an equal share, and is cut when it is used up"""
    video: bool = False
    """record each episode as an mp4 file in the run's folder videos (pip install moviepy pygame-ce)"""


class RecordFlags(PlayFlags, frozen=True, kw_only=True):
    """Write a Minari dataset: episodes of a run's newest policy, with raw rewards (pip install 'minari[hdf5]' pillow)."""

    out: str
    """id of the dataset, such as cartpole/expert-v0; it is written to MINARI_DATASETS_PATH, or to ~/.minari/datasets"""
    steps: Count = 50_000
    """number of env steps; the last episode is finished, unless that would more than double the number"""
    npy: Annotated[Path | None, Flag("PATH")] = None
    """also write this .npy file: a float32 array with a row [observation, action], flattened, for each step"""
    stochastic: bool = False
    """sample actions from the policy, as in training, instead of taking the most probable ones"""
    seed: Natural = 2_000_000
    """seed of the episodes and of the sampled actions"""
