"""The flags that all launchers share, and the flags of each launcher."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from millrace.flags.fields import Flag
from millrace.protocol.bounds import Count


class LaunchFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Flags of every launcher. Put flags of `millrace learner` after `--`: millrace launch … -- --steps 1000000."""

    env: Annotated[str, Flag(positional=True)]
    """environment id for gymnasium.make, such as CartPole-v1 or my_package.envs:MyEnv-v0"""
    workers: Count = 4
    """number of worker processes; with Ray, of actors"""
    name: str = "millrace"
    """name of the run on the cluster: lowercase letters, digits and dashes"""


class KubernetesFlags(LaunchFlags, frozen=True, kw_only=True):
    """Print a Kubernetes manifest with a learner and workers: millrace launch kubernetes ENV > k8s.yaml."""

    keys: str = ""
    """key folder to write into the manifest as a Secret; the manifest itself must then be kept secret"""
    learner_image: str = "millrace-learner"
    """name by which the cluster finds the image built from docker/Dockerfile, target learner"""
    worker_image: str = "millrace-worker"
    """name by which the cluster finds the image built from docker/Dockerfile, target worker"""
    storage: str = "10Gi"
    """size of the volume for run folders"""
    learner_cpu: str = "2"
    """CPU cores of the learner"""
    learner_memory: str = "4Gi"
    """memory limit of the learner"""
    worker_cpu: str = "1"
    """CPU cores of each worker"""
    worker_memory: str = "512Mi"
    """memory limit of each worker"""


class SlurmFlags(LaunchFlags, frozen=True, kw_only=True):
    """Print the script of one Slurm job with a learner and workers: millrace launch slurm ENV > run.sbatch."""

    folder: Path = Path()
    """folder that all nodes share, for runs, keys and logs; if not given, the current folder"""
    time: str = "24:00:00"
    """time limit of the job"""
    save_s: Count = 120
    """this many seconds before the time limit, the run is saved and the job is queued again to continue"""
    cpus: Count = 1
    """CPU cores of each worker, and of the learner"""
    partition: str = ""
    """partition of the cluster; if not given, the cluster's default"""
    python: Path = Path()
    """Python interpreter on every node that has millrace installed; if not given, the one that runs this command"""


class RayFlags(LaunchFlags, frozen=True, kw_only=True):
    """Train with workers on a Ray cluster: the learner here, each worker in an actor (pip install ray)."""

    address: str = "auto"
    """address of the cluster, HOST:PORT; auto is the environment variable RAY_ADDRESS, or the cluster of this machine"""
    processes: int = 1
    """worker processes in each actor, which takes as many of Ray's cores"""
    port: int = 5555
    """port where the learner listens, on this node's address"""
