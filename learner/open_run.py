"""Assembles a run: the algorithm, the hub, and everything that happens between two updates.

This file imports PyTorch. `learner/run_setup.py` has the parts of a run that must exist before. For a resumed run, nothing
is written before all checks have passed.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import msgspec
import torch

from millrace.learner.algorithms import Algorithm, algorithm_class
from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.between_updates.audience import Audience
from millrace.learner.between_updates.evaluations import Evaluations
from millrace.learner.between_updates.run_files import RunFiles
from millrace.learner.between_updates.run_parts import RunParts
from millrace.learner.between_updates.tally import Tally
from millrace.learner.callbacks.callbacks import Callbacks, Watch
from millrace.learner.config.algorithm_names import FOR_PRIOR
from millrace.learner.config.config import Config
from millrace.learner.config.costs import large_observations
from millrace.learner.config.validation import unused_setting
from millrace.learner.extras import started_by
from millrace.learner.members.lobby import Lobby
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.open_hub import open_hub
from millrace.learner.resume_checks import naming_run
from millrace.learner.rollouts.hub import Hub, HubObserver
from millrace.learner.rollouts.opponent_pool import OpponentPool, PoolSettings, PoolState
from millrace.learner.run import OpenRun
from millrace.learner.run_folder.callback_requests import Requests
from millrace.learner.run_folder.env_attributes import EnvAttributes
from millrace.learner.run_folder.progress_file import ProgressFile
from millrace.learner.run_setup import RunSetup
from millrace.learner.run_spec import run_spec
from millrace.learner.run_state import SavedRun, restore, start_from
from millrace.learner.shards.roles import lead
from millrace.learner.shards.sharded import new_sharded
from millrace.learner.torch_setup import threads, torch_device, updates_use_all_cores
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.kinds_of_copies import has_attributes
from millrace.protocol.errors import UsageError
from millrace.protocol.logs.notices import log_notice
from millrace.protocol.machine.waiting_threads import SPIN, VARIABLE
from millrace.protocol.policy.flattened_images import flattened_images
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec, RunSpec

log = logging.getLogger("millrace.learner")


def open_run(setup: RunSetup, lobby: Lobby, watch: Watch, observer: HubObserver) -> OpenRun:
    """Open the run described by this setup, with the workers in the lobby. The run folder must be ready.

    `watch` is the run's callbacks, or a function to call after each update. `observer` is called each time the hub has
    listened. For a resumed run, nothing is written before all checks have passed. Raises `MillraceError` if the run can't
    be opened.
    """
    callbacks = Callbacks.of(watch).with_named(setup.config.callbacks)
    if setup.config.tensorboard:
        callbacks.add(started_by("tensorboard")(setup.folder))  # last, so that it gets what the other callbacks log
    if line := unused_setting(setup.config):
        log.warning("%s", line)
    with naming_run(setup.folder.shown if setup.resumed else None):
        spec = run_spec(setup.config, setup.known.env, setup.known.spaces)
    for line in flattened_images(spec.policy):
        log.warning("%s", line)
    if torch_device(setup.config) == "cpu" and (line := large_observations(setup.config, spec.policy)):
        log_notice(log, line)
    setup = _use_threads(setup, spec.policy, lobby.processes)
    config = setup.config
    folder = setup.folder
    algorithm, prior = _new_algorithm(setup, spec)
    saved = restore(folder, algorithm) if setup.resumed else SavedRun()
    # The last save gets half of the remaining grace time, because the workers need time to leave.
    folder.writes.at_most = lambda seconds: setup.interrupts.at_most(2 * seconds) / 2
    pool = _opponent_pool(config, spec, saved.state.opponents)
    progress_file = ProgressFile(folder.path)

    def watch_hub(listened: Hub) -> None:
        observer(listened)
        if setup.learners is not None:
            setup.learners.still_waits()
        if folder.lock is None or not folder.lock.taken_over:
            progress_file.write(listened.progress, time.time())

    hub = open_hub(config, spec, lobby, setup.check_running, watch_hub, saved.rollouts, pool)
    if saved.opponent_policies is not None and pool is not None:
        hub.keep_opponents(*saved.opponent_policies)
    if config.record:
        resumed_at = saved.state.env_steps if setup.resumed else None
        name = folder.path.resolve().name
        callbacks.add(started_by("record")(config.record, setup.known.described, spec, name, resumed_at))
    setup.check_interrupt()
    if setup.resumed and folder.callbacks and not callbacks.passed:
        log.warning("%s", _without_callbacks(folder.callbacks))
    folder.callbacks = callbacks.passed
    folder.remove_temporary()
    folder.write_config(config, workers_elsewhere=not lobby.processes.expected)
    folder.remove_summary()
    tally = Tally(config, spec, saved, lambda: callbacks.stop_reason, pool)
    parts = RunParts(config, spec, folder, algorithm, hub, tally)
    requests = Requests(EnvAttributes(saved.env_attributes, _why_no_attributes(spec.vector)))
    evaluations = Evaluations(parts, setup.known.evaluation_limit)
    files = RunFiles(parts, evaluations, requests.attributes)
    run = OpenRun(setup, parts, files, Audience(parts, callbacks, files, requests), evaluations, prior)
    hub.report_progress(run.audience.progress())
    if setup.resumed:
        log_notice(log, files.continues())
    folder.keep()
    return run


def _without_callbacks(names: Sequence[str]) -> str:
    """A line about the callbacks without which a run is resumed."""
    return one_line(
        f"the run continues without the callbacks that a Python program passed to it ({', '.join(names)}): only that "
        "program can pass them again, with callbacks=[…]",
        500,
    )


def _why_no_attributes(vector: str) -> str:
    """Why attributes of the env copies can't be set, or an empty string if they can."""
    if has_attributes(vector):
        return ""
    return f"the env copies of vector {vector} have no attributes"


def _opponent_pool(config: Config, spec: RunSpec, state: PoolState) -> OpponentPool | None:
    """The run's opponents; None if the policy plays all agents itself."""
    if not spec.teams:
        return None
    settings = PoolSettings(
        seed=config.seed,
        window=config.self_play,
        save_steps=config.self_play_save_steps,
        latest=config.self_play_latest,
        max_lag=config.max_lag,
        scripted=len(spec.scripted),
        teams=len(spec.teams),
    )
    return OpponentPool(settings, state)


def _use_threads(setup: RunSetup, policy: PolicySpec, processes: WorkerProcesses) -> RunSetup:
    """Set PyTorch's number of threads for the run. Returns the setup with this number."""
    config = setup.config
    if config.torch_threads is None and config.shards > 1:
        config = msgspec.structs.replace(config, torch_threads=1)  # because several processes share a machine's cores
    elif config.torch_threads is None:
        # Another number of threads changes the last bits of results, so the run keeps this one wherever it is resumed.
        chosen = threads(policy, config.algorithm.minibatch_rows(config.envs), config.max_lag, processes.expected)
        config = msgspec.structs.replace(config, torch_threads=chosen.number)
        if chosen.line:
            log_notice(log, chosen.line)
    torch.set_num_threads(config.torch_threads or 1)
    if SPIN and (config.torch_threads or 1) > 1:
        log.warning(
            "PyTorch was imported before millrace, so its threads spin while they wait for one another, and updates take "
            "far longer beside busy processes; import millrace first, or set %s=PASSIVE",
            VARIABLE,
        )
    if updates_use_all_cores(config):
        processes.lower_priority()
    return replace(setup, config=config)


def _new_algorithm(setup: RunSetup, spec: RunSpec) -> tuple[Algorithm, PriorData | None]:
    """Create a run's algorithm, and its prior data if the settings name any.

    A new run's algorithm starts from another run if the settings say so; a resumed run's algorithm is restored later.
    """
    config = setup.config
    folder = setup.folder
    policy = spec.policy
    device = torch_device(config)
    algorithm: Algorithm
    if setup.learners is None:
        algorithm = algorithm_class(config.algo)(
            config.algorithm, policy, total_steps=config.steps, seed=config.seed, device=device
        )
    else:
        algorithm = new_sharded(config, policy, device, setup.learners)
        lead(setup.learners, config, policy, folder.shown)
    if config.start_from and not setup.resumed:
        folder.started_from = start_from(config, policy, algorithm)
        log_notice(log, folder.started_from)
    if not config.prior:
        return algorithm, None
    if spec.masked and policy.head == "q":
        raise UsageError(
            f"prior {config.prior}: a dataset has no action masks, and this run uses them; take --action-masks none"
        )
    return algorithm, _add_prior(algorithm, config.prior, policy, setup.check_interrupt)


@dataclass(frozen=True)
class _InterruptiblePrior:
    """Prior data that calls `check` after reading each episode, so that an exception from `check` can end the reading."""

    data: PriorData
    check: Callable[[], None]

    @property
    def rows(self) -> int:
        return self.data.rows

    @property
    def episodes(self) -> int:
        return self.data.episodes

    def batches(self) -> Iterator[Batch]:
        for batch in self.data.batches():
            self.check()
            yield batch


def _add_prior(algorithm: Algorithm, dataset_id: str, policy: PolicySpec, check: Callable[[], None]) -> PriorData:
    if missing := [name for name in FOR_PRIOR if not hasattr(algorithm, name)]:
        raise UsageError(f"prior {dataset_id}: {type(algorithm).__name__} lacks {', '.join(missing)}")
    prior: PriorData = started_by("prior")(dataset_id, policy)
    algorithm.add_prior(_InterruptiblePrior(prior, check))
    log.info("prior %s: %d transitions of %d episodes", dataset_id, prior.rows, prior.episodes)
    return prior
