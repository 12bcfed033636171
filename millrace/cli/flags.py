"""The flags of the commands that look at runs, or edit keys."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
from tyro.conf import Positional


class EvaluateFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Greedy episodes of a run's newest policy: mean and standard deviation of the return."""

    run: Positional[Path]
    """the run folder"""
    episodes: int | None = None
    """how many; if not given 100, and 3 with --video"""
    seed: int = 1_000_000
    """of the episodes; another seed, other episodes"""
    best: bool = False
    """of the policy that did best in the run's own evaluations (--eval-every), instead of the newest"""
    video: bool = False
    """film them: an mp4 of each in the run's videos folder (pip install 'millrace-rl[video]')"""
    debug: bool = False
    """show the traceback of an error"""


class PlotFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Learning curves as a PNG: a panel for each environment, a colour for each algorithm, seeds as a band."""

    runs: Positional[tuple[Path, ...]]
    """run folders"""
    out: Path | None = None
    """the PNG; curves.png in the first run folder if not given"""
    debug: bool = False
    """show the traceback of an error"""


class RecordFlags(msgspec.Struct, frozen=True, kw_only=True):
    """A Minari dataset of a run's newest policy: whole episodes, raw rewards (pip install 'millrace-rl[record]')."""

    run: Positional[Path]
    """the run folder"""
    out: str
    """the dataset's id, as in cartpole/expert-v0; it is written where MINARI_DATASETS_PATH says, or to ~/.minari/datasets"""
    steps: int = 50_000
    """env steps; the last episode is finished, and cut only where that would double them"""
    best: bool = False
    """the policy that did best in the run's own evaluations (--eval-every), instead of the newest"""
    npy: Path | None = None
    """also write this file: an array of rows [observation, action], float32, flattened, one for each step"""
    stochastic: bool = False
    """draw actions from the policy, as in training, instead of taking the most probable"""
    seed: int = 2_000_000
    """of the episodes and of the drawn actions"""
    debug: bool = False
    """show the traceback of an error"""


class ReportFlags(msgspec.Struct, frozen=True, kw_only=True):
    """One HTML page about runs side by side: results, learning curves, settings, ledger, stages, films."""

    runs: Positional[tuple[Path, ...]]
    """run folders"""
    out: Path | None = None
    """the page; report.html in the first run folder if not given"""
    debug: bool = False
    """show the traceback of an error"""


class LaunchFlags(msgspec.Struct, frozen=True, kw_only=True):
    """What every launcher takes. Flags of `millrace learner` stand behind `--`: millrace launch … -- --steps 1000000."""

    env: Positional[str]
    """anything gymnasium.make takes"""
    workers: int = 4
    """worker processes; of Ray, actors"""
    name: str = "millrace"
    """of all that belongs to this run: small letters, digits and dashes"""
    debug: bool = False
    """show the traceback of an error"""


class KubernetesFlags(LaunchFlags, frozen=True, kw_only=True):
    """A learner and workers as Kubernetes knows them, on stdout: millrace launch kubernetes ENV > k8s.yaml."""

    keys: str = ""
    """a key folder: its learner's key and join token become a Secret of the manifest, which is then itself secret"""
    learner_image: str = "millrace-learner"
    """docker/Dockerfile, target learner; where the cluster finds it"""
    worker_image: str = "millrace-worker"
    """docker/Dockerfile, target worker"""
    storage: str = "10Gi"
    """for run folders"""
    learner_cpu: str = "2"
    """cores"""
    learner_memory: str = "4Gi"
    """its bound"""
    worker_cpu: str = "1"
    """cores of each worker"""
    worker_memory: str = "512Mi"
    """of each worker, its bound"""


class SlurmFlags(LaunchFlags, frozen=True, kw_only=True):
    """A learner and workers as one Slurm job, on stdout: millrace launch slurm ENV > run.sbatch; sbatch run.sbatch."""

    folder: Path = Path()
    """a folder that all nodes share: runs, keys and logs go there; the current one if not given"""
    time: str = "24:00:00"
    """the job's time limit"""
    save_s: int = 120
    """so long before the time limit the run is saved, and the job queued again to go on"""
    cpus: int = 1
    """cores of each worker, and of the learner"""
    partition: str = ""
    """of the cluster; its own default if not given"""
    python: Path = Path(sys.executable)
    """the Python that has millrace, on every node"""


class RayFlags(LaunchFlags, frozen=True, kw_only=True):
    """The learner here, its workers as actors of the Ray cluster of this machine (pip install 'millrace-rl[ray]')."""

    address: str = "auto"
    """of the cluster, as HOST:PORT; if not given, RAY_ADDRESS or the one that runs here"""
    processes: int = 1
    """worker processes of each actor, which takes so many of Ray's cores"""
    port: int = 5555
    """where the learner listens, on the address of this node"""
