"""Describes the workers that this program starts for a learner: their number, flags, log files and CPU cores."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from millrace.learner.config.config import Config
from millrace.learner.config.local_workers import local_workers
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.run_folder.regular_files import open_regular, reason, subfolder
from millrace.protocol.errors import UsageError
from millrace.protocol.wire.shared_memory import InheritedDescriptors
from millrace.protocol.wire.wake_up import WakePipe
from millrace.workers.conversation.connection_rules import LEARNER_STARTED_IT_S
from millrace.workers.supervise.supervisor import core_flags


@dataclass(frozen=True)
class InheritedByWorkers:
    """Shared memory and wake pipes that local workers inherit. They exist before the sizes of the arrays are known."""

    memory_fd: int
    to_workers: Mapping[str, WakePipe]
    """the pipe that wakes each worker, by its name"""
    to_learner: WakePipe
    """the pipe that wakes the learner; the last worker to finish a step writes to it"""

    def of(self, worker: str) -> InheritedDescriptors:
        """The file descriptors that this worker inherits."""
        return InheritedDescriptors(self.memory_fd, self.to_workers[worker].read_fd, self.to_learner.write_fd)


@dataclass(frozen=True)
class Crew:
    """Which workers to start. They are called w0, w1, and so on."""

    count: int = 0
    lanes: int = 0
    """the run's lanes, if its settings leave the number of workers open and a better number may be suggested; otherwise 0"""
    envs: int = 0
    """the env copies in these lanes"""
    evaluating: int = 0
    """how many of the workers, counted from the last one, only evaluate"""
    logs: Path | None = None
    """the folder of the workers' logs; None: workers write to this process's stderr"""
    cores: Sequence[int] = ()
    """the cores to which workers are pinned, in turn; empty: workers aren't pinned"""
    inherited: InheritedByWorkers | None = None
    """what the workers' processes inherit; None: nothing"""

    def evaluates(self, worker: str) -> bool:
        """Whether this worker only evaluates."""
        return int(worker.removeprefix("w")) >= self.collecting

    @property
    def collecting(self) -> int:
        """How many of the workers collect."""
        return self.count - self.evaluating

    def log_of(self, worker: str) -> Path | None:
        """The file to which this worker's stderr goes; None: to this process's stderr."""
        return None if self.logs is None else self.logs / f"{worker}.log"

    def descriptors_of(self, worker: str) -> InheritedDescriptors | None:
        """The file descriptors that this worker inherits, if any."""
        return None if self.inherited is None else self.inherited.of(worker)

    def flags_of(self, worker: str) -> list[str]:
        """The command-line flags of this worker's process."""
        flags = [*core_flags(self.cores, worker), "--join-timeout-s", str(LEARNER_STARTED_IT_S)]
        if self.evaluates(worker):
            flags.append("--evaluate")
        if (descriptors := self.descriptors_of(worker)) is not None:
            flags += ["--handed", ",".join(map(str, descriptors))]
        return flags


def crew_of_run(config: Config, run: Path) -> Crew:
    """The workers of a run that are started on this machine. Their logs go to the run folder.

    Raises `UsageError` if the logs can't be written there.
    """
    crew = Crew(local_workers(config) + config.eval_workers, evaluating=config.eval_workers)
    if config.transport == "inproc":
        return crew
    crew = replace(crew, logs=_log_folder(run))
    if config.inference == "learner":  # a pinned worker that only steps would push the thread that acts off its core
        return crew
    if config.workers is None:
        crew = replace(crew, lanes=config.lanes, envs=config.envs)
    return replace(crew, cores=[] if config.eval_workers else worker_cores(config))


def _log_folder(run: Path) -> Path:
    """The folder of the workers' logs. Raises `UsageError` unless existing logs in it are regular files."""
    try:
        logs = subfolder(run, "workers")
        for log in logs.glob("*.log"):
            os.close(open_regular(log))
    except OSError as error:
        raise UsageError(f"{error.filename}: {reason(error)}; the workers' logs go there: remove it") from error
    return logs


def worker_cores(config: RolloutConfig) -> list[int]:
    """The cores to which local workers are pinned, in turn; empty if they aren't pinned.

    New weights wake all workers at once, while the learner is still running. Linux then often puts two workers on one core
    and leaves another core idle, but too briefly to move a worker there. Workers aren't pinned if there are fewer of them
    than cores, because Linux then finds a free core for each, whereas pinned workers might share a core with another run's
    workers. Nor are they pinned in a run with a lag, because nothing would be gained.
    """
    if not hasattr(os, "sched_setaffinity"):
        return []
    cores = sorted(os.sched_getaffinity(0))
    return cores if config.max_lag == 0 and local_workers(config) % len(cores) == 0 else []
