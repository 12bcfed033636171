"""Makes a learner of its parts: algorithm, hub, and what a run does between two updates. Imports PyTorch.

`learner/run_setup.py` says what must exist before. Nothing of a resumed run is written before everything fits.
"""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import msgspec
import torch

from millrace.learner.algorithms import Algorithm, algorithm_class
from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.between_updates.between_updates import BetweenUpdates, open_files
from millrace.learner.between_updates.crowded_cores import CrowdedCores
from millrace.learner.between_updates.run_parts import RunParts
from millrace.learner.between_updates.tally import Tally
from millrace.learner.callbacks.callbacks import Callbacks, Watch
from millrace.learner.config.algorithm_names import FOR_PRIOR
from millrace.learner.config.config import Config
from millrace.learner.config.costs import large_observations, minibatch_rows
from millrace.learner.config.validation import unused_setting
from millrace.learner.conversations import open_hub
from millrace.learner.extras import started_by
from millrace.learner.members.bound import Bound
from millrace.learner.members.lobby import Lobby
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.rollouts.hub import Hub, HubObserver
from millrace.learner.rollouts.opponent_pool import OpponentPool, PoolSettings, PoolState
from millrace.learner.run_folder.lease import Closed, Listens
from millrace.learner.run_folder.progress_file import ProgressFile
from millrace.learner.run_folder.run_folder import Interrupted
from millrace.learner.run_setup import RunSetup
from millrace.learner.run_spec import run_spec
from millrace.learner.run_state import RunState, restore, start_from
from millrace.learner.torch_setup import threads, torch_device, updates_use_all_cores
from millrace.learner.train import train
from millrace.protocol.address import advertised_address, own_address
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import MillraceError, RunTakenOver, UsageError, first_line
from millrace.protocol.logs.notices import log_notice
from millrace.protocol.machine.waiting_threads import SPIN, VARIABLE
from millrace.protocol.policy.flattened_images import flattened_images
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec, RunSpec

log = logging.getLogger("millrace.learner")

DRAIN_S = 2.0  # for the workers to leave, when a run is cut short


@dataclass(frozen=True)
class OpenRun:
    """A learner that listens to workers and has not begun to train. `open_run` makes it."""

    setup: RunSetup
    policy: PolicySpec
    algorithm: Algorithm
    hub: Hub
    between: BetweenUpdates
    prior: PriorData | None
    """The data that the run learns from besides its own, if there are any."""

    def announce(self, bound: Bound, advertise: str) -> None:
        """Say in the lock of the run folder that `millrace status` may ask at this address; or why it cannot."""
        address = bound.link.address
        keyring = bound.keyring
        lock = self.setup.folder.lock
        if lock is None:
            return
        if address.startswith("inproc://"):
            lock.announce(Closed.INPROC)
        elif keyring is not None and keyring.folder is None:
            lock.announce(Closed.KEYS_OF_THE_RUN)
        else:
            keys = "" if keyring is None or keyring.folder is None else str(keyring.folder.path.absolute())
            others = advertised_address(address, advertise, socket.gethostname())
            lock.announce(Listens(others, own_address(address), keys))

    def train(self, workers: int) -> None:
        """Wait for this number of `workers`, then train to the end.

        `setup.interrupts` must be entered. Raises `Interrupted` if the user interrupts the run, and `MillraceError`, with a
        one-line message, if it fails.
        """
        files, audience = self.between.files, self.between.audience
        try:
            if self.prior is not None and self.between.tally.state.version == 0:
                self._learn_from_prior(self.prior)
            config = self.setup.config
            cores = CrowdedCores((config.torch_threads or 1) if torch_device(config) == "cpu" else 0)
            train(self.algorithm, self.policy, self.hub, self.between, workers, self._check_time, cores)
        except RunTakenOver as error:
            reason = str(error)
            self.hub.drain(reason, timeout_s=DRAIN_S)
            self._end_after_error(lambda: audience.leave(reason))
            raise
        except BaseException as error:
            if line := files.saved(elsewhere=self.setup.elsewhere):
                error.add_note(line)
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else _why(error)
            self.hub.drain(reason, timeout_s=self.setup.interrupts.at_most(DRAIN_S))
            self._end_after_error(lambda: audience.finish(reason, cut_short=True))
            raise
        finally:
            files.close()

    def _end_after_error(self, end: Callable[[], None]) -> None:
        """Tell the callbacks. One of them may raise again, but the error of the run is what counts."""
        try:
            end()
        except Exception as later:
            log.warning("%s", _why(later))

    def _learn_from_prior(self, prior: PriorData) -> None:
        """Make the gradient steps before the first rollouts, with checkpoints when it is time, and at an interrupt."""
        tally, files, audience, _ = self.between

        def pulse() -> None:
            self.hub.pulse()
            files.save_if_due()
            self.setup.check_running()

        try:
            if getattr(self.setup.config.algorithm, "clone_epochs", 0):
                audience.cloned(started_by("clone_epochs")(self.algorithm, prior.batches(), pulse))
                tally.state.next_evaluation = 0  # one is due, if the run makes any
            self.algorithm.learn_from_prior(pulse)
        except Interrupted:
            files.save()
            files.confirm_saved()
            raise

    def _check_time(self) -> None:
        if self.setup.interrupts.time_is_up(self.between.files.longest_save_s):
            raise Interrupted(self.setup.folder.shown)


def open_run(setup: RunSetup, lobby: Lobby, watch: Watch, observer: HubObserver) -> OpenRun:
    """The run of this setup, whose folder is ready, for the workers in the lobby. Raises `MillraceError`.

    `watch`: the callbacks of the run, or a function to call after each update. `observer` is called each time the hub has
    listened. Nothing of a resumed run is written before everything fits.
    """
    callbacks = Callbacks.of(watch).with_named(setup.config.callbacks)
    if setup.config.tensorboard:
        callbacks.add(started_by("tensorboard")(setup.folder))  # last, so that it gets what the others log
    if line := unused_setting(setup.config):
        log.warning("%s", line)
    spec = run_spec(setup.config, setup.known.env, setup.known.spaces)
    for line in flattened_images(spec.policy):
        log.warning("%s", line)
    if torch_device(setup.config) == "cpu" and (line := large_observations(setup.config, spec.policy)):
        log_notice(log, line)
    setup = _use_threads(setup, spec.policy, lobby.processes)
    config, folder = setup.config, setup.folder
    algorithm, prior = _new_algorithm(setup, spec)
    state = restore(folder, algorithm) if setup.resumed else RunState()
    # The last save gets half of what is left of the grace time, and the workers need time to leave.
    folder.writes.at_most = lambda seconds: setup.interrupts.at_most(2 * seconds) / 2
    past = (state.ledger, state.incarnations)
    pool = _opponent_pool(config, spec, state.opponents)
    progress_file = ProgressFile(folder.path)

    def watch_hub(listened: Hub) -> None:
        observer(listened)
        if folder.lock is None or not folder.lock.taken_over:
            progress_file.write(listened.progress, time.time())

    hub = open_hub(config, spec, lobby, setup.check_running, watch_hub, past, pool)
    if state.opponent_policies is not None and pool is not None:
        hub.keep_opponents(*state.opponent_policies)
    state.opponent_policies = None
    if config.record:
        about = f"All whole training episodes of millrace run {folder.path.resolve().name}, as acted."
        callbacks.add(started_by("record")(config.record, setup.known.described, spec, about))
    setup.check_interrupt()
    folder.remove_temporary()
    folder.write_config(config, workers_elsewhere=not lobby.processes.expected)
    folder.remove_summary()
    tally = Tally(config, spec, state, lambda: callbacks.stop_reason, pool)
    parts = RunParts(config, spec, folder, algorithm, hub, tally)
    between = open_files(parts, callbacks, setup.known.evaluation_limit)
    run = OpenRun(setup, spec.policy, algorithm, hub, between, prior)
    hub.report_progress(between.audience.progress())
    if setup.resumed:
        log_notice(log, between.files.continues())
    folder.keep()
    return run


def _opponent_pool(config: Config, spec: RunSpec, state: PoolState) -> OpponentPool | None:
    """The opponents of the run, if the policy does not play all teams."""
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
    """Let PyTorch use the run's number of threads. Returns the setup with that number."""
    config = setup.config
    if config.torch_threads is None:
        # Another number changes the last bits, so the run keeps it, wherever it is resumed or repeated.
        chosen = threads(policy, minibatch_rows(config), config.max_lag, processes.expected)
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
    """An algorithm that starts from another run, if it is to, and has its prior data. A resumed one has its own start."""
    config, folder, policy = setup.config, setup.folder, spec.policy
    algorithm = algorithm_class(config.algo)(
        config.algorithm, policy, total_steps=config.steps, seed=config.seed, device=torch_device(config)
    )
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


def _why(error: BaseException) -> str:
    """One line that says why the run ended. The error may come from a user's code, and say anything."""
    text = first_line(error, type(error).__name__)
    return one_line(text if isinstance(error, MillraceError) else f"{type(error).__name__}: {text}")


@dataclass(frozen=True)
class _InterruptiblePrior:
    """Prior data whose reading `check` may end: it is called after each episode, and what it raises passes."""

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
