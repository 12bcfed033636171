"""Makes a learner of its parts: link, coordinator, hub, service, algorithm, and what a run does between two updates.

The order is: bind the link; make or open the run folder; start the workers (a launcher does that); let a worker describe the
environment, while PyTorch is imported (`known_environment`); open the `Run` (`open_run`); train. This file does not know who
the workers are, and the learner runs no code of the environment.
"""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from learner.algorithms import Algorithm
from learner.callbacks.callbacks import Callbacks, Watch
from learner.config.algorithm_names import FOR_PRIOR
from learner.config.config import Config
from learner.config.validation import unused_target
from learner.env_spaces import EnvSpaces
from learner.imports_ahead import ImportsAhead
from learner.interrupts import Interrupts
from learner.members.describe import described_by_workers
from learner.members.describe_coordinator import Accept
from learner.members.process_callbacks import ProcessCallbacks
from learner.recording.prior_dataset import PriorDataset
from learner.recording.training_recorder import TrainingRecorder
from learner.resume_checks import Resumption, check_spaces
from learner.rollout_service.service import RolloutService, describe_settings, rollout_service
from learner.rollouts.hub import HubObserver
from learner.run_folder.lease import Closed, Listens
from learner.run_folder.run_folder import Interrupted, RunFolder
from learner.run_folder.run_lock import RunLock
from learner.torch_setup import threads, torch_device, updates_use_all_cores
from protocol.address import advertised_address, own_address
from protocol.bounds import one_line
from protocol.env_spec import EnvSpec
from protocol.envs.description import DescribedEnv
from protocol.errors import MillraceError, RunTakenOver, UsageError, first_line
from protocol.keys.key_folder import Keyring
from protocol.logs.notices import log_notice
from protocol.rollout import Batch
from protocol.specs import DescribeSpec, PolicySpec, RunSpec
from protocol.wire.learner_link import LearnerLink

if TYPE_CHECKING:  # it imports PyTorch
    from learner.between_updates.between_updates import BetweenUpdates

log = logging.getLogger("millrace.learner")

DRAIN_S = 2.0  # for the workers to leave, when a run is cut short


def stopped(resumed: Path | None) -> KeyboardInterrupt:
    """The exception if the user stops the program before it trains. `resumed`: the run that it was to resume, if any."""
    return KeyboardInterrupt() if resumed is None else Interrupted(resumed)


@dataclass(frozen=True)
class KnownEnvironment:
    """What a run must know of its environment before it begins."""

    env: EnvSpec
    spaces: EnvSpaces
    described: DescribedEnv
    """As a worker described it."""
    evaluation_limit: int | None
    """Env steps after which an episode of an evaluation is truncated, if it is."""


@dataclass(frozen=True)
class RunSetup:
    """The parts of a run that exist before the `Run`."""

    config: Config
    known: KnownEnvironment
    folder: RunFolder
    resumed: bool
    interrupts: Interrupts
    """Entered: signals are noted from now on."""

    def check_interrupt(self) -> None:
        """Raises `KeyboardInterrupt` if the user has stopped the program, before there is anything to save."""
        if self.interrupts.received:
            raise stopped(self.folder.path if self.resumed else None)

    def check_running(self) -> None:
        """Raises `Interrupted` if the user has interrupted the run, and `RunTakenOver` if another process trains it."""
        if self.interrupts.received:
            raise Interrupted(self.folder.path)
        if self.folder.lock is not None:
            self.folder.lock.check()


@contextmanager
def run_folder(config: Config, resume: Resumption | None) -> Iterator[RunFolder]:
    """A new run folder, or the folder of the run to `resume`, locked. A new one is removed if no `Run` can be made of it.

    Raises `UsageError`, also if another process trains the run.
    """
    folder = RunFolder.create(config) if resume is None else RunFolder.open(resume.run)
    try:
        with RunLock(folder.path) as folder.lock:
            for line in () if resume is None else resume.differences:
                log.warning("%s", line)
            yield folder
    except BaseException:
        folder.remove()
        raise


def check_evaluation_spaces(config: Config, training: DescribedEnv, evaluation: DescribedEnv) -> None:
    """Raises `UsageError` if an environment with `eval_env_kwargs` has other spaces than one without them."""
    expected, got = (EnvSpaces.of_description(env, config.action_masks) for env in (training, evaluation))
    if (expected.observation, expected.action) != (got.observation, got.action):
        raise UsageError(
            f"eval_env_kwargs: expected the spaces of training, {training.observation_space} and {training.action_space}, "
            f"got {evaluation.observation_space} and {evaluation.action_space}"
        )


Describe = Callable[[DescribeSpec, Callable[[], None], Accept], DescribedEnv]
"""Has a worker describe the environment. What the second argument raises ends the wait; the third accepts a description."""


def named_environment(config: Config) -> EnvSpec:
    """The environment that the settings name."""
    return EnvSpec.of(config.env, config.env_kwargs, config.wrapper, config.eval_env_kwargs)


def known_environment(config: Config, env: EnvSpec, resume: Resumption | None, describe: Describe) -> KnownEnvironment:
    """The environment, as `describe` learns it. Meanwhile another thread imports PyTorch.

    Of a run to `resume`, only an environment with the spaces of the run's policy is accepted. Raises `UsageError` if there
    is no such environment, or no policy for it; `RunError` if no worker describes it in time; and `KeyboardInterrupt` if
    the user stops the program.
    """
    imports = ImportsAhead(config.algo)
    with Interrupts() as interrupts:

        def check_interrupt() -> None:
            if interrupts.received:
                raise stopped(None if resume is None else resume.run)

        policy = None if resume is None else RunFolder.open(resume.run).policy_spec()

        def accept(found: DescribedEnv) -> None:
            if resume is not None and policy is not None:
                check_spaces(resume.run, EnvSpaces.of_policy(policy), EnvSpaces.of_description(found, config.action_masks))

        described = describe(
            DescribeSpec(env, config.chosen_vector(), heartbeat_s=config.heartbeat_s), check_interrupt, accept
        )
        evaluation = described
        if env.eval_kwargs:
            spec = DescribeSpec(env.for_evaluation(), heartbeat_s=config.heartbeat_s)
            evaluation = describe(spec, check_interrupt, lambda found: None)
            check_evaluation_spaces(config, described, evaluation)
        imports.wait(check_interrupt)
    spaces = EnvSpaces.of_description(described, config.action_masks)
    if spaces.masked:
        log_notice(log, f"only actions that the environment allows are taken (action_masks {config.action_masks})")
    return KnownEnvironment(env, spaces, described, evaluation.max_episode_steps)


def describe_over(link: LearnerLink, config: Config, processes: ProcessCallbacks) -> Describe:
    """Has one of the workers at the link of the run describe the environment."""
    settings = describe_settings(config, config.steps)
    return lambda spec, check_interrupt, accept: described_by_workers(
        link, spec, settings, processes, check_interrupt, accept=accept
    )


@dataclass(frozen=True)
class Run:
    """A learner that listens to workers and has not begun to train. `open_run` makes it."""

    setup: RunSetup
    algorithm: Algorithm
    service: RolloutService
    between: BetweenUpdates
    prior: PriorDataset | None
    """The data that the run learns from besides its own, if there are any."""

    def announce(self, address: str, advertise: str, keyring: Keyring | None) -> None:
        """Say in the lock of the run folder that `millrace status` may ask at this address; or why it cannot."""
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
        from learner.train import train

        files, audience = self.between.files, self.between.audience
        try:
            if self.prior is not None and self.between.tally.state.version == 0:
                self._learn_from_prior(self.prior)
            train(self.algorithm, self.service, self.between, workers, self._check_time)
        except RunTakenOver as error:
            self.service.drain(str(error), timeout_s=DRAIN_S)
            raise
        except BaseException as error:
            if line := files.saved():
                error.add_note(line)
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else _why(error)
            self.service.drain(reason, timeout_s=self.setup.interrupts.at_most(DRAIN_S))
            try:
                audience.finish(reason, cut_short=True)
            except Exception as later:  # a callback may raise again, and the error of the run is what counts
                log.warning("%s", _why(later))
            raise
        finally:
            files.close()
            audience.close()

    def _learn_from_prior(self, prior: PriorDataset) -> None:
        """Make the gradient steps before the first rollouts, with checkpoints when it is time, and at an interrupt."""
        tally, files, audience, _ = self.between

        def pulse() -> None:
            self.service.pulse()
            files.save_if_due()
            self.setup.check_running()

        try:
            if getattr(self.setup.config.algorithm, "clone_epochs", 0):
                audience.cloned(self.algorithm.clone(prior.batches(), pulse))
                tally.state.next_evaluation = 0  # one is due, if the run makes any
            self.algorithm.learn_from_prior(pulse)
        except Interrupted:
            files.save()
            files.confirm_saved()
            raise

    def _check_time(self) -> None:
        if self.setup.interrupts.time_is_up(self.between.files.longest_save_s):
            raise Interrupted(self.setup.folder.path)


def open_run(setup: RunSetup, link: LearnerLink, processes: ProcessCallbacks, watch: Watch, observer: HubObserver) -> Run:
    """The run of this setup, whose folder is ready. Raises `MillraceError`.

    `watch`: the callbacks of the run, or a function to call after each update. `observer` is called each time the hub has
    listened. `processes` are the worker processes that this program started. Nothing of a resumed run is written before
    everything fits.
    """
    from learner.between_updates.between_updates import open_files
    from learner.between_updates.run_parts import RunParts
    from learner.between_updates.tally import Tally
    from learner.run_spec import run_spec
    from learner.run_state import RunState, restore

    callbacks = Callbacks.of(watch).with_named(setup.config.callback)
    if line := unused_target(setup.config):
        log.warning("%s", line)
    spec = run_spec(setup.config, setup.known.env, setup.known.spaces)
    setup = _use_threads(setup, spec.policy, processes)
    config, folder = setup.config, setup.folder
    algorithm, prior = _new_algorithm(setup, spec)
    state = restore(folder, algorithm) if setup.resumed else RunState()
    # The last save gets half of what is left of the grace time, and the workers need time to leave.
    folder.writes.at_most = lambda seconds: setup.interrupts.at_most(2 * seconds) / 2
    past = (state.ledger, state.incarnations)
    service = rollout_service(config, spec, link, processes, setup.check_running, observer, past)
    dataset = _training_recorder(config, folder, setup.known, spec)
    setup.check_interrupt()
    folder.remove_temporary()
    folder.write_config(config, workers_elsewhere=not processes.expected)
    folder.remove_summary()
    tally = Tally(config, spec, state, lambda: callbacks.stop_reason)
    parts = RunParts(config, spec, folder, algorithm, service, tally)
    between = open_files(parts, callbacks, dataset, setup.known.evaluation_limit)
    run = Run(setup, algorithm, service, between, prior)
    service.report(between.audience.progress())
    if setup.resumed:
        log_notice(log, between.files.continues())
    folder.keep()
    run.announce(link.address, config.advertise, link.keyring)
    return run


def _use_threads(setup: RunSetup, policy: PolicySpec, processes: ProcessCallbacks) -> RunSetup:
    """Let PyTorch use the run's number of threads. Returns the setup with that number."""
    import torch

    config = setup.config
    if config.torch_threads is None:
        # Another number changes the last bits, so the run keeps it, wherever it is resumed or repeated.
        config = msgspec.structs.replace(config, torch_threads=threads(policy, config.max_lag, processes.expected))
    torch.set_num_threads(config.torch_threads or 1)
    if updates_use_all_cores(config):
        processes.lower_priority()
    return replace(setup, config=config)


def _new_algorithm(setup: RunSetup, spec: RunSpec) -> tuple[Algorithm, PriorDataset | None]:
    """An algorithm that starts from another run, if it is to, and has its prior data. A resumed one has its own start."""
    from learner.algorithms import algorithm_class
    from learner.run_state import start_from

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


def _add_prior(algorithm: Algorithm, dataset_id: str, policy: PolicySpec, check: Callable[[], None]) -> PriorDataset:
    if missing := [name for name in FOR_PRIOR if not hasattr(algorithm, name)]:
        raise UsageError(f"prior {dataset_id}: {type(algorithm).__name__} lacks {', '.join(missing)}")
    dataset = PriorDataset(dataset_id, policy)

    def batches() -> Iterator[Batch]:
        for batch in dataset.batches():
            check()
            yield batch

    algorithm.add_prior(batches(), dataset.rows + dataset.episodes)
    log.info("prior %s: %d transitions of %d episodes", dataset_id, dataset.rows, dataset.episodes)
    return dataset


def _training_recorder(config: Config, folder: RunFolder, known: KnownEnvironment, spec: RunSpec) -> TrainingRecorder | None:
    if not config.record:
        return None
    about = f"All whole training episodes of millrace run {folder.path.resolve().name}, as acted."
    return TrainingRecorder(config.record, known.described, spec, about)


def prometheus_observer(config: Config) -> AbstractContextManager[HubObserver]:
    """Serves metrics at `config.metrics_bind` while it is entered; without an address it imports no HTTP server."""
    if not config.metrics_bind:
        return nullcontext(lambda hub: None)
    from learner.prometheus import metrics_server

    return metrics_server(config)
