"""Makes a learner of its parts: link, coordinator, hub, service, algorithm, recorder.

The order is: bind the link; make or open the run folder; start the workers (a launcher does that); let a worker describe the
environment, while PyTorch is imported (`known_environment`); make the `Run`; train. This file does not know who the workers
are, and the learner runs no code of the environment.
"""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

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
from learner.resumption import Resumption, check_spaces
from learner.rollout_service.service import describe_settings, rollout_service
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
from protocol.messages import Status
from protocol.rollout import Batch
from protocol.specs import DescribeSpec, PolicySpec, RunSpec
from protocol.wire.learner_link import LearnerLink

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


class Run:
    """A learner that listens to workers and has not begun to train."""

    def __init__(
        self,
        setup: RunSetup,
        link: LearnerLink,
        processes: ProcessCallbacks,
        watch: Watch,
        observer: HubObserver,
    ) -> None:
        """`watch`: the callbacks of the run, or a function to call after each update. Raises `MillraceError`.

        `observer` is called each time the hub has listened. `processes` are the worker processes that this program started.
        """
        import torch

        from learner.algorithms import algorithm_class
        from learner.run_recorder import EpisodeSettings, RunRecorder
        from learner.run_spec import run_spec
        from learner.run_state import RunState, restore, start_from

        config, self.folder = setup.config, setup.folder
        made = Callbacks.of(watch).with_named(config.callback)
        if line := unused_target(config):
            log.warning("%s", line)
        spec = run_spec(config, setup.known.env, setup.known.spaces)
        if config.torch_threads is None:
            # Another number changes the last bits, so the run keeps it, wherever it is resumed or repeated.
            config = msgspec.structs.replace(config, torch_threads=threads(spec.policy, config.max_lag, processes.expected))
        torch.set_num_threads(config.torch_threads or 1)
        if updates_use_all_cores(config):
            processes.lower_priority()
        self.algorithm = algorithm_class(config.algo)(
            config.algorithm, spec.policy, total_steps=config.steps, seed=config.seed, device=torch_device(config)
        )
        # A fresh algorithm gets its start here: from another run, then from prior data. A resumed one has its own state.
        if config.start_from and not setup.resumed:
            self.folder.started_from = start_from(config, spec.policy, self.algorithm)
            log_notice(log, self.folder.started_from)
        if config.prior:
            if spec.masked and spec.policy.head == "q":
                raise UsageError(
                    f"prior {config.prior}: a dataset has no action masks, and this run uses them; take --action-masks none"
                )
            self._prior = _add_prior(self.algorithm, config.prior, spec.policy, setup.check_interrupt)
        state = RunState()
        if setup.resumed:
            state = restore(self.folder, self.algorithm)
        self._interrupts = setup.interrupts
        # The last save gets half of what is left of the grace time, and the workers need time to leave.
        self.folder.writes.at_most = lambda seconds: setup.interrupts.at_most(2 * seconds) / 2
        self._learns_from_prior, self._clones = bool(config.prior), bool(getattr(config.algorithm, "clone_epochs", 0))
        past = (state.ledger, state.incarnations)
        self.service = rollout_service(config, spec, link, processes, self._check_interrupt, observer, past)
        episodes = EpisodeSettings(_training_recorder(config, self.folder, setup.known, spec), setup.known.evaluation_limit)
        setup.check_interrupt()
        self.folder.remove_temporary()
        # Nothing of a resumed run is written before everything fits.
        self.folder.write_config(config, workers_elsewhere=not processes.expected)
        self.folder.remove_summary()
        self.recorder = RunRecorder(config, self.folder, spec, self.algorithm, self.service, state, made, episodes)
        if setup.resumed:
            log_notice(log, self.recorder.continues())
        self.folder.keep()
        self.announce(link.address, config.advertise, link.keyring)

    def announce(self, address: str, advertise: str, keyring: Keyring | None) -> None:
        """Say in the lock of the run folder that `millrace status` may ask at this address; or why it cannot."""
        if self.folder.lock is None:
            return
        if address.startswith("inproc://"):
            self.folder.lock.announce(Closed.INPROC)
        elif keyring is not None and keyring.folder is None:
            self.folder.lock.announce(Closed.KEYS_OF_THE_RUN)
        else:
            keys = "" if keyring is None or keyring.folder is None else str(keyring.folder.path.absolute())
            others = advertised_address(address, advertise, socket.gethostname())
            self.folder.lock.announce(Listens(others, own_address(address), keys))

    def status(self, now: float) -> Status:
        """The answer to `millrace status`. `now`: seconds of the monotonic clock."""
        return self.service.status(now)

    def train(self, workers: int) -> None:
        """Wait for this number of `workers`, then train to the end.

        `setup.interrupts` must be entered. Raises `Interrupted` if the user interrupts the run, and `MillraceError`, with a
        one-line message, if it fails.
        """
        from learner.train import train

        try:
            if self._learns_from_prior and self.recorder.version == 0:
                self._learn_from_prior()
            train(self.algorithm, self.service, self.recorder, workers, self._check_time)
        except RunTakenOver as error:
            self.service.drain(str(error), timeout_s=DRAIN_S)
            raise
        except BaseException as error:
            if line := self.recorder.saved():
                error.add_note(line)
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else _why(error)
            self.service.drain(reason, timeout_s=self._interrupts.at_most(DRAIN_S))
            try:
                self.recorder.finish(reason, cut_short=True)
            except Exception as later:  # a callback may raise again, and the error of the run is what counts
                log.warning("%s", _why(later))
            raise
        finally:
            self.recorder.close()

    def _learn_from_prior(self) -> None:
        """Make the gradient steps before the first rollouts, with checkpoints when it is time, and at an interrupt."""

        def pulse() -> None:
            self.service.pulse()
            self.recorder.save_if_time()
            self._check_interrupt()

        try:
            if self._clones:
                self.recorder.cloned(self.algorithm.clone(self._prior.batches(), pulse))
            self.algorithm.learn_from_prior(pulse)
        except Interrupted:
            self.recorder.save()
            self.recorder.confirm_saved()
            raise

    def _check_interrupt(self) -> None:
        if self._interrupts.received:
            raise Interrupted(self.folder.path)
        if self.folder.lock is not None:
            self.folder.lock.check()

    def _check_time(self) -> None:
        if self._interrupts.time_is_up(self.recorder.longest_save_s):
            raise Interrupted(self.folder.path)


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
