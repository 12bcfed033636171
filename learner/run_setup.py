"""The parts of a run that exist before PyTorch is imported: its folder, its environment's description, and its interrupts.

A run is set up in this order: bind the link; create or open the run folder; start the workers (a launcher does this); let
one of them describe the environment, while another thread imports PyTorch (`known_environment`); open the run
(`learner/open_run.py`), which takes over the workers; train. This file does not know who starts the workers, and the learner
runs no environment code.
"""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from millrace.learner.algorithms.replay.hindsight import goals_not_used
from millrace.learner.config.config import Config
from millrace.learner.config.costs import endless_evaluations
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.extras import started_by
from millrace.learner.imports_ahead import ImportsAhead
from millrace.learner.interrupts import Interrupts
from millrace.learner.members.bound import Bound
from millrace.learner.members.describe_coordinator import Unknown
from millrace.learner.members.lobby import Lobby
from millrace.learner.resume_checks import Resumption, check_spaces
from millrace.learner.rollouts.hub import HubObserver
from millrace.learner.run_folder.json_log import kept_log
from millrace.learner.run_folder.lease import Listens, Unreachable
from millrace.learner.run_folder.run_folder import Interrupted, RunFolder
from millrace.learner.run_folder.run_lock import RunLock
from millrace.protocol.address import advertised_address, own_address
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.advice.atari_ids import preprocessed
from millrace.protocol.envs.description import DescribedEnv, agents_in_words
from millrace.protocol.errors import UsageError
from millrace.protocol.logs.notices import log_notice

if TYPE_CHECKING:
    from millrace.learner.shards.learners import Learners

log = logging.getLogger("millrace.learner")


def stopped(resumed: Path | None) -> KeyboardInterrupt:
    """The exception to raise if the user stops the program before training. `resumed` is the run to resume, if any."""
    return KeyboardInterrupt() if resumed is None else Interrupted(resumed)


@dataclass(frozen=True)
class KnownEnvironment:
    """What a run must know about its environment before it begins."""

    env: EnvSpec
    spaces: EnvSpaces
    described: DescribedEnv
    """A worker's description of the environment."""
    evaluation_limit: int | None
    """The number of env steps after which an evaluation episode is truncated; None without a limit."""


@dataclass(frozen=True)
class RunSetup:
    """The parts of a run that exist before the `OpenRun`."""

    config: Config
    known: KnownEnvironment
    folder: RunFolder
    resumed: bool
    interrupts: Interrupts
    """Must be entered, so that signals are recorded."""
    learners: Learners | None = None
    """The learner processes of a run with shards, which share the updates."""

    def announce(self, bound: Bound) -> None:
        """Write to the run's lock the address at which `millrace status` reaches the learner, or why it can't reach it."""
        address = bound.link.address
        keyring = bound.keyring
        lock = self.folder.lock
        if lock is None:
            return
        if address.startswith("inproc://"):
            lock.announce(Unreachable.INPROC)
        elif keyring is not None and keyring.folder is None:
            lock.announce(Unreachable.KEYS_OF_THE_RUN)
        else:
            keys = "" if keyring is None or keyring.folder is None else str(keyring.folder.path.absolute())
            others = advertised_address(address, self.config.advertise, socket.gethostname())
            lock.announce(Listens(others, own_address(address), keys))

    def check_interrupt(self) -> None:
        """Raise `KeyboardInterrupt` if the user has stopped the program. Use this while there is nothing to save."""
        if self.interrupts.received:
            raise stopped(self.folder.shown if self.resumed else None)

    def check_running(self) -> None:
        """Raise `Interrupted` if the user has interrupted the run, and `RunTakenOver` if another process trains it."""
        if self.interrupts.received:
            raise Interrupted(self.folder.shown)
        if self.folder.lock is not None:
            self.folder.lock.check()


@contextmanager
def run_folder(config: Config, resume: Resumption | None) -> Iterator[RunFolder]:
    """Create a new run folder, or open the folder of the run that `resume` names. Inside the context, it is locked.

    If the body raises before the run has begun, a new folder is removed. Inside the context, a page shows the run if
    `config` says so. Raises `UsageError` if the folder can't be used, or if another process trains the run.
    """
    folder = RunFolder.create(config) if resume is None else RunFolder.open(resume.run)
    folder.stay()
    try:
        with RunLock(folder.path) as folder.lock, kept_log(folder.path), _page_beside(config, folder.path):
            for line in () if resume is None else resume.differences:
                log.warning("%s", line)
            yield folder
    except BaseException:
        folder.remove()
        raise


def _page_beside(config: Config, run: Path) -> AbstractContextManager[None]:
    """A context that shows the run in a browser, if `config` says so."""
    if not config.dashboard:
        return nullcontext()
    page: AbstractContextManager[None] = started_by("dashboard")(run)
    return page


def _spaces(config: Config, env: DescribedEnv) -> EnvSpaces:
    return EnvSpaces.of_description(env, config.action_masks, config.critic_keys)


def check_evaluation_spaces(config: Config, training: DescribedEnv, evaluation: DescribedEnv) -> None:
    """Raise `UsageError` if `eval_env_kwargs` change the environment's spaces or agents."""
    expected, got = (_spaces(config, env) for env in (training, evaluation))
    if (expected.observation, expected.action) != (got.observation, got.action):
        raise UsageError(
            f"eval_env_kwargs: expected the spaces of training, {training.observation_space} and {training.action_space}, "
            f"got {evaluation.observation_space} and {evaluation.action_space}"
        )
    if (expected.seats, expected.takes_turns) != (got.seats, got.takes_turns):
        agents = [agents_in_words(env.seats, env.takes_turns) for env in (training, evaluation)]
        raise UsageError(f"eval_env_kwargs: expected the agents of training, {agents[0]}; got {agents[1]}")


def named_environment(config: Config) -> EnvSpec:
    """The environment that the settings name."""
    return EnvSpec.of(config.env, config.env_kwargs, config.all_wrappers(), config.eval_env_kwargs)


def known_environment(config: Config, env: EnvSpec, resume: Resumption | None, lobby: Lobby) -> KnownEnvironment:
    """Let a worker in the lobby describe the environment. Meanwhile, another thread imports PyTorch.

    If `resume` is given, only an environment with the spaces of that run's policy is accepted. Raises `UsageError` if the
    environment doesn't exist or no policy can use it, `RunError` if no worker describes it in time, and `KeyboardInterrupt`
    if the user stops the program.
    """
    imports = ImportsAhead(config.algo)
    with Interrupts() as interrupts:

        def check_interrupt() -> None:
            if interrupts.received:
                raise stopped(None if resume is None else resume.run)

        saved = None if resume is None else RunFolder.open(resume.run).policy_description()

        def accept(found: DescribedEnv) -> None:
            if resume is not None and saved is not None:
                check_spaces(resume.run, EnvSpaces.of_policy(saved.policy, saved.seats), _spaces(config, found))

        def answer_workers() -> None:
            check_interrupt()
            lobby.listen()

        evaluation = lobby.describe(Unknown(env.for_evaluation()), check_interrupt) if env.eval_kwargs else None
        # The training environment is described last, so that its copy is kept for the first lane.
        described = lobby.describe(Unknown(env, config.vector, accept=accept), check_interrupt)
        if evaluation is None:
            evaluation = described
        else:
            check_evaluation_spaces(config, described, evaluation)
        imports.wait(answer_workers)
    spaces = _spaces(config, described)
    if spaces.masked:
        log_notice(log, f"only actions that the environment allows are taken (action_masks {config.action_masks})")
    if env.factory is None and not env.wrappers and (ours := preprocessed(env.id)):
        log_notice(log, f"{env.id} shows raw frames, one at a time; {ours} has the usual wrappers, and presets")
    if line := endless_evaluations(config, evaluation):
        log_notice(log, line)
    if line := goals_not_used(config.algorithm, spaces.observation, config.env):
        log_notice(log, line)
    return KnownEnvironment(env, spaces, described, evaluation.max_episode_steps)


def prometheus_observer(config: Config) -> AbstractContextManager[HubObserver]:
    """A context that serves metrics at `config.metrics_bind`. Without an address, no HTTP server is imported."""
    if not config.metrics_bind:
        return nullcontext(lambda hub: None)
    server: AbstractContextManager[HubObserver] = started_by("metrics_bind")(config)
    return server
