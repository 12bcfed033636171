"""The roles of the learner processes of a run with shards: rank 0 leads, and the others follow.

Law: rank 0 is the learner, just as in a run without shards: it has the workers, the run folder and the callbacks. The others
know the run only from rank 0's messages: their own settings don't count, they accept no workers, and they write no file of
the run.
"""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from millrace.learner.config.config import Config
from millrace.learner.config.layers import config_from_toml
from millrace.learner.interrupts import Interrupts
from millrace.learner.run_folder.run_format import versions
from millrace.learner.shards.learners import Learners, Timeouts, connected
from millrace.learner.shards.messages import Begin, End, Learn, StillThere
from millrace.learner.shards.place import Place
from millrace.learner.shards.sharded import Sharded, new_sharded
from millrace.learner.torch_setup import one_thread, torch_device
from millrace.protocol.errors import RunError, first_line
from millrace.protocol.logs.notices import log_notice
from millrace.protocol.specs import PolicySpec

log = logging.getLogger("millrace.learner")


def timeouts(config: Config) -> Timeouts:
    """How long the processes of a run wait for each other: longer before the run begins, when rank 0 waits for workers."""
    return Timeouts(config.no_workers_timeout_s + config.shard_timeout_s, config.shard_timeout_s)


def lead(learners: Learners, config: Config, policy: PolicySpec, run: Path) -> None:
    """Start the run in the other processes. Returns once they have made its algorithm.

    Raises `UsageError` if one of them can't take part.
    """
    learners.tell_all(Begin(config.to_toml(), policy, str(run), torch_device(config), versions()))
    learners.agree()
    division = learners.division
    log_notice(log, f"{division.shards} shards, {len(division.own)} for each of {division.processes} learner processes")


def follow(config: Config, place: Place) -> Path:
    """Take part in the updates of a run that rank 0 leads.

    Returns the path of the run folder, which may be on another machine; if the run had already finished, the path of the
    folder of all runs.

    Ctrl-C and SIGTERM don't end this process once the run has begun, because launchers send them to all processes, and rank
    0 then ends the run. Of `config`, only the timeouts, `shards`, `device` and `run_dir` matter.
    """
    interrupts = Interrupts()

    def poll() -> None:
        if interrupts.received:
            raise KeyboardInterrupt

    with (
        interrupts,
        one_thread(),
        connected(place, config.shards, torch_device(config), timeouts(config), poll) as learners,
    ):
        match learners.hear():
            case Begin() as begin:
                algorithm = algorithm_of(begin, learners)
            case End(reason, failed=False):
                log_notice(log, f"rank {place.rank}: {reason}")
                return Path(config.run_dir)
            case End(reason):
                raise RunError(f"learner: rank {place.rank}: {reason}")
            case other:
                raise RunError(f"learner: rank {place.rank}: expected the run from rank 0, got {type(other).__name__}")
        log_notice(log, f"rank {place.rank} of {place.processes} takes part in the updates of run {begin.run}")
        while True:
            match learners.hear():
                case Learn() as learn:
                    algorithm.follow(learn)
                    del learn  # free its memory before the next batch arrives
                case StillThere():
                    pass
                case End(reason, failed=True):
                    raise RunError(f"learner: rank {place.rank}: {reason}")
                case End(reason):
                    log_notice(log, f"rank {place.rank}: {reason}")
                    return Path(begin.run)
                case other:
                    raise RunError(f"learner: rank {place.rank}: expected a batch, got {type(other).__name__}")


def algorithm_of(begin: Begin, learners: Learners) -> Sharded:
    """Make, in this process, the same algorithm as rank 0. If any process can't, all raise `UsageError`."""
    rank = learners.division.rank
    try:
        config = config_from_toml(begin.config, "the settings of rank 0")
        learners.division = learners.division._replace(shards=config.shards)
        torch.set_num_threads(config.torch_threads or 1)
        algorithm = new_sharded(config, begin.policy, begin.device, learners)
        error = _other_versions(begin.versions, versions())
    except Exception as refused:  # of any type, because the other processes wait for a report
        error = first_line(refused, type(refused).__name__)
    learners.agree(f"learner: rank {rank}: {error}" if error else "")
    return algorithm


def _other_versions(expected: dict[str, str], got: dict[str, str]) -> str:
    """The first difference between the package versions of two processes, in one line; empty if there is none."""
    for name, version in expected.items():
        if got.get(name) != version:
            return f"{name}: expected {version}, as rank 0 has, got {got.get(name, 'none')}; install the same in both"
    return ""
