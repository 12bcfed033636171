"""What the learner processes of a run with shards do: rank 0 leads, and the others follow.

Law: rank 0 is the learner of a run as without shards: workers, run folder, callbacks. The others know the run only from what
it tells: their own settings don't count, and they open no port and write no file of the run.
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
    """How long the processes of a run wait for each other. Before a run begins, rank 0 may wait for its workers."""
    return Timeouts(config.no_workers_timeout_s + config.shard_timeout_s, config.shard_timeout_s)


def lead(learners: Learners, config: Config, policy: PolicySpec, run: Path) -> None:
    """Tell the others the run. Returns when they have its algorithm. Raises `UsageError` if one of them can't take part."""
    learners.tell_all(Begin(config.to_toml(), policy, str(run), torch_device(config), versions()))
    learners.agree()
    division = learners.division
    log_notice(log, f"{division.shards} shards, {len(division.own)} for each of {division.processes} learner processes")


def follow(config: Config, place: Place) -> Path:
    """Take part in the updates of a run that rank 0 leads. Returns the path of its folder, which may be on another machine;
    that of the folder of all runs if the run was finished before.

    Ctrl-C and SIGTERM don't end this process once the run has begun: launchers send them to all processes, and rank 0 ends
    the run. `config`: only its timeouts count, and whether there is a GPU.
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
            case Begin() as begin, _:
                algorithm = algorithm_of(begin, learners)
            case End(reason, failed=False), _:
                log_notice(log, f"rank {place.rank}: {reason}")
                return Path(config.run_dir)
            case End(reason), _:
                raise RunError(f"learner: rank {place.rank}: {reason}")
            case other, _:
                raise RunError(f"learner: rank {place.rank}: expected the run from rank 0, got {type(other).__name__}")
        log_notice(log, f"rank {place.rank} of {place.processes} takes part in the updates of run {begin.run}")
        while True:
            match learners.hear():
                case Learn() as learn, arrays:
                    algorithm.follow(learn, arrays)
                    del arrays  # before the next come
                case StillThere(), _:
                    pass
                case End(reason, failed=True), _:
                    raise RunError(f"learner: rank {place.rank}: {reason}")
                case End(reason), _:
                    log_notice(log, f"rank {place.rank}: {reason}")
                    return Path(begin.run)
                case other, _:
                    raise RunError(f"learner: rank {place.rank}: expected a batch, got {type(other).__name__}")


def algorithm_of(begin: Begin, learners: Learners) -> Sharded:
    """The algorithm of rank 0, in this process. All processes fail if it can't be made here."""
    rank = learners.division.rank
    try:
        config = config_from_toml(begin.config, "the settings of rank 0")
        learners.division = learners.division._replace(shards=config.shards)
        torch.set_num_threads(config.torch_threads or 1)
        algorithm = new_sharded(config, begin.policy, begin.device, learners)
        error = _other_versions(begin.versions, versions())
    except Exception as refused:  # whatever it is, the others wait to hear it
        error = first_line(refused, type(refused).__name__)
    learners.agree(f"learner: rank {rank}: {error}" if error else "")
    return algorithm


def _other_versions(expected: dict[str, str], got: dict[str, str]) -> str:
    """How the packages of two processes differ; empty if they don't."""
    for name, version in expected.items():
        if got.get(name) != version:
            return f"{name}: expected {version}, as rank 0 has, got {got.get(name, 'none')}; install the same in both"
    return ""
