"""A run on this machine: the learner in this process, and worker processes (over inproc: threads) that it starts.

Rule: whatever happens, no worker, socket file or temporary folder is left behind.
"""

from __future__ import annotations

import logging
from contextlib import ExitStack
from pathlib import Path

from learner.callbacks.callbacks import Watch
from learner.config.config import Config
from learner.config.validation import check_copies, idle_workers, workers_to_wait_for
from learner.interrupts import Interrupts
from learner.members.endpoint import BindSettings
from learner.resumption import Resumption, unless_finished
from learner.run import (
    Run,
    RunSetup,
    describe_over,
    known_environment,
    named_environment,
    prometheus_observer,
    run_folder,
)
from learner.torch_setup import one_thread
from millrace.launch.endpoint import open_endpoint
from millrace.launch.local_worker_options import no_flags, stopped_on_error, worker_flags
from protocol.env_spec import EnvSpec
from workers.slots import LIMIT_VARIABLE, copies_per_machine
from workers.supervise.supervisor import STOP_WITHIN_S

log = logging.getLogger("millrace.learner")


def train(config: Config, resume: Path | None, watch: Watch, env: EnvSpec | None = None) -> Path:
    """Train. Returns the run folder. `env`: the environment, if the settings do not name one that workers find.

    Raises `UserFacingError`, or `Interrupted` if the user stopped the run.
    """
    return unless_finished(config, resume, lambda checked: _train(config, checked, watch, env))


def _train(config: Config, resume: Resumption | None, watch: Watch, env: EnvSpec | None) -> Path:
    env = env or named_environment(config)
    check_copies(config, LIMIT_VARIABLE, copies_per_machine())  # all copies of the run are on this machine
    if config.inference == "learner":
        from millrace.launch import learner_inference as inference

        return inference.train(config, resume, watch, env)
    workers = workers_to_wait_for(config, config.workers)
    if line := idle_workers(config):
        log.warning("%s", line)
    with ExitStack() as stack:
        where = BindSettings(keys=config.keys, insecure=config.insecure)
        code = env.called_code or ("an encoder" if config.algorithm.encoder else "")
        endpoint = open_endpoint(where, config.transport, stack, code)
        observer = stack.enter_context(prometheus_observer(config))
        folder = stack.enter_context(run_folder(config, resume))
        flags = no_flags if config.transport == "inproc" else worker_flags(config, folder.path)
        supervisor, processes = stack.enter_context(endpoint.workers(config.workers, flags, config.call_timeouts()))
        interrupts = Interrupts(config.grace_s)
        stack.callback(lambda: supervisor.stop(interrupts.at_most(STOP_WITHIN_S)))
        with stopped_on_error(supervisor):
            known = known_environment(config, env, resume, describe_over(endpoint.link, config, processes))
        with interrupts, one_thread():
            setup = RunSetup(config, known, folder, resume is not None, interrupts)
            Run(setup, endpoint.link, processes, watch, observer).train(workers)
        return folder.path
