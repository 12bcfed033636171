"""A run: the learner in this process, and workers that it starts on this machine or that join from elsewhere.

Rule: whatever happens, no worker, socket file or temporary folder is left behind.
"""

from __future__ import annotations

import logging
from contextlib import ExitStack
from pathlib import Path

from millrace.launch.endpoint import open_endpoint
from millrace.launch.local_worker_options import FlagsOfWorker, no_flags, stopped_on_error, worker_flags
from millrace.learner.callbacks.callbacks import Watch
from millrace.learner.config.config import Config
from millrace.learner.config.validation import check_copies, idle_workers, workers_to_wait_for
from millrace.learner.conversations import lobby_settings
from millrace.learner.extras import check_packages
from millrace.learner.interrupts import Interrupts
from millrace.learner.members.lobby import Lobby
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.resume_checks import Resumption, unless_finished
from millrace.learner.run_setup import (
    RunSetup,
    known_environment,
    named_environment,
    prometheus_observer,
    run_folder,
)
from millrace.learner.torch_setup import one_thread
from millrace.protocol.env_spec import EnvSpec
from millrace.workers.machine_slots import LIMIT_VARIABLE, copies_per_machine
from millrace.workers.supervise.supervisor import STOP_WITHIN_S

log = logging.getLogger("millrace.learner")


def train(config: Config, resume: Path | None, watch: Watch, env: EnvSpec | None = None, *, elsewhere: bool = False) -> Path:
    """Train. Returns the run folder. `env`: the environment, if the settings do not name one that workers find.

    `elsewhere`: the workers are started elsewhere and join at `config.bind`. Raises `UserFacingError`, or `Interrupted` if
    the user stopped the run.
    """
    return unless_finished(config, resume, lambda checked: _train(config, checked, watch, env, elsewhere=elsewhere))


def _train(config: Config, resume: Resumption | None, watch: Watch, env: EnvSpec | None, *, elsewhere: bool) -> Path:
    check_packages(config)
    env = env or named_environment(config)
    if not elsewhere:
        check_copies(config, LIMIT_VARIABLE, copies_per_machine())  # all copies of the run are on this machine
    if config.inference == "learner":
        from millrace.launch import learner_inference as inference

        return inference.train(config, resume, watch, env, elsewhere=elsewhere)
    workers = workers_to_wait_for(config, None if elsewhere else config.workers)
    if not elsewhere and (line := idle_workers(config)):
        log.warning("%s", line)
    with ExitStack() as stack:
        # A run to resume is locked before the address is bound: of two learners of one run, the second is told so.
        folder = None if resume is None else stack.enter_context(run_folder(config, resume))
        where = BindSettings(config.bind if elsewhere else "", config.keys, config.insecure, config.advertise)
        # Workers elsewhere decide for themselves whether they take code.
        code = "" if elsewhere else env.called_code or ("an encoder" if config.algorithm.encoder else "")
        endpoint = open_endpoint(where, config.transport, stack, code)
        observer = stack.enter_context(prometheus_observer(config))
        flags: FlagsOfWorker = no_flags
        if not elsewhere:
            folder = folder or stack.enter_context(run_folder(config, None))
            if config.transport != "inproc":
                flags = worker_flags(config, folder.path)
        started = endpoint.workers(config.workers + config.eval_workers, flags, evaluating=config.eval_workers)
        supervisor, processes = stack.enter_context(started)
        interrupts = Interrupts(config.grace_s)
        stack.callback(lambda: supervisor.stop(interrupts.at_most(STOP_WITHIN_S)))
        with stopped_on_error(supervisor):
            lobby = Lobby(endpoint.link, processes, lobby_settings(config, config.steps))
            known = known_environment(config, env, resume, lobby)
        folder = folder or stack.enter_context(run_folder(config, None))  # not before a worker elsewhere has come
        from millrace.learner.run import open_run  # imports PyTorch, which was done while a worker described the environment

        with interrupts, one_thread():
            setup = RunSetup(config, known, folder, resume is not None, interrupts, elsewhere)
            open_run(setup, lobby, watch, observer).train(workers)
        return folder.shown
