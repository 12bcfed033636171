"""Trains a run: the learner is in this process, and workers are started on this machine or join from elsewhere."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from millrace.launch.crew import Crew, crew_of_run
from millrace.launch.worker_pool import WorkerPool, open_worker_pool
from millrace.learner.callbacks.callbacks import Watch
from millrace.learner.config.config import Config
from millrace.learner.config.local_workers import local_workers, uneven_lanes
from millrace.learner.config.validation import check_copies, workers_to_wait_for
from millrace.learner.extras import check_packages
from millrace.learner.interrupts import Interrupts
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.open_hub import lobby_settings
from millrace.learner.resume_checks import Resumption, unless_finished
from millrace.learner.run_folder.progress_file import progress_before
from millrace.learner.run_folder.run_folder import Interrupted
from millrace.learner.run_setup import (
    RunSetup,
    known_environment,
    named_environment,
    prometheus_observer,
    run_folder,
    stopped,
)
from millrace.learner.shards.place import ALONE, Place, check_loopback, trains_alone
from millrace.learner.torch_setup import one_thread, torch_device
from millrace.learner.whole_run import train_to_the_end
from millrace.protocol.env_spec import EnvSpec
from millrace.workers.machine_slots import LIMIT_VARIABLE, copies_per_machine
from millrace.workers.supervise.supervisor import STOP_WITHIN_S

if TYPE_CHECKING:
    from millrace.learner.shards.learners import Learners

log = logging.getLogger("millrace.learner")


def train(config: Config, resume: Path | None, watch: Watch, env: EnvSpec | None = None, *, elsewhere: bool = False) -> Path:
    """Train a policy. Returns the run folder.

    `env`: the environment, unless workers find it by the name in the settings. `elsewhere`: workers are started elsewhere
    and join at `config.bind`. Raises `UserFacingError` if the run fails, or `Interrupted` if the user stopped it, even if
    training had ended by then.

    In a run with shards, rank 0 of the learner processes has the workers and the run folder; the other ranks take part in
    its updates.
    """
    place = _place(config)
    if config.shards == 1 and (line := trains_alone(os.environ)):
        log.warning("%s", line)
    check_loopback(place, insecure=config.insecure_shards)
    if place.rank > 0:  # its machine may lack both the run folder and the folder of the run to start from
        from millrace.learner.shards.roles import follow  # imports PyTorch

        return follow(config, place)
    trained: list[Path] = []

    def lead(checked: Resumption | None) -> Path:
        trained.append(_train(config, checked, watch, env, place, elsewhere=elsewhere))
        return trained[0]

    run = unless_finished(config, resume, lead)
    if not trained and place.processes > 1:
        _tell_finished(config, place)
    return run


def leads(config: Config) -> bool:
    """Whether this process has the run folder; in a run with shards only rank 0 has it."""
    return _place(config).rank == 0


def _place(config: Config) -> Place:
    return Place.of(os.environ) if config.shards > 1 else ALONE


def _train(
    config: Config, resume: Resumption | None, watch: Watch, env: EnvSpec | None, place: Place, *, elsewhere: bool
) -> Path:
    check_packages(config)
    env = env or named_environment(config)
    acts = config.inference == "learner"
    if not elsewhere:
        check_copies(config, LIMIT_VARIABLE, copies_per_machine())  # all env copies of the run will be on this machine
        if not acts and (line := uneven_lanes(config)):
            log.warning("%s", line)
    here = local_workers(config)
    stepping = min(here, config.envs) if acts else here
    workers = workers_to_wait_for(config, None if elsewhere else stepping)
    with ExitStack() as stack:
        # A run to resume is locked before the address is bound, so that a second learner of the run gets the right error.
        folder = None if resume is None else stack.enter_context(run_folder(config, resume))
        pool = stack.enter_context(_pool(config, env, workers, elsewhere=elsewhere))
        observer = stack.enter_context(prometheus_observer(config))
        crew = Crew()
        if not elsewhere:
            folder = folder or stack.enter_context(run_folder(config, None))
            crew = crew_of_run(config, folder.path)
        progress = progress_before(None if resume is None else resume.run, config.steps)
        lobby = stack.enter_context(pool.start(crew, lobby_settings(config, progress)))
        known = known_environment(config, env, resume, lobby)
        lobby = pool.begin(known.described)
        interrupts = Interrupts(config.grace_s)
        stack.callback(lambda: pool.stop(interrupts.at_most(STOP_WITHIN_S)))
        folder = folder or stack.enter_context(run_folder(config, None))  # if workers are elsewhere: once one has joined
        from millrace.learner.open_run import (
            open_run,  # imports PyTorch, unless it was imported while a worker described the environment
        )

        def poll() -> None:
            lobby.listen()
            if interrupts.received:
                raise stopped(None if resume is None else resume.run)

        with interrupts, one_thread(), _learners(config, place, poll) as learners:
            setup = RunSetup(config, known, folder, resume is not None, interrupts, learners)
            run = open_run(setup, lobby, watch, observer)
            pool.report(run.parts.hub.status)
            setup.announce(pool.bound)
            train_to_the_end(run, 1 if acts else workers)
        if interrupts.received:  # after training, as in `on_end`: the run is complete, but the caller's program must end
            raise Interrupted(folder.shown, complete=True)
        return folder.shown


def _tell_finished(config: Config, place: Place) -> None:
    """Tell the other learner processes, which have no run folder to read, that the run was already finished."""
    with _learners(config, place, lambda: None) as learners:
        if learners is not None:
            learners.end("the run was finished before")


def _learners(config: Config, place: Place, poll: Callable[[], None]) -> AbstractContextManager[Learners | None]:
    """A context manager: the connected learner processes that share the updates; None in a run without shards."""
    if config.shards == 1:
        return nullcontext()
    from millrace.learner.shards.learners import connected  # imports PyTorch
    from millrace.learner.shards.roles import timeouts

    return connected(place, config.shards, torch_device(config), timeouts(config), poll)


def _pool(config: Config, env: EnvSpec, workers: int, *, elsewhere: bool) -> AbstractContextManager[WorkerPool]:
    """The pool of the run's workers. No rollout begins until `workers` of them have joined."""
    where = BindSettings(config.bind if elsewhere else "", config.keys, config.insecure, config.advertise)
    if config.inference == "workers":
        code = env.called_code or ("an encoder" if config.algorithm.encoder else "")
        code = code or ("an opponent" if config.opponents else "")
        return open_worker_pool(where, config.transport, code)
    from millrace.launch.learner_inference import open_stepping_pool, settings_of_run

    return open_stepping_pool(settings_of_run(config, env, where, workers))
