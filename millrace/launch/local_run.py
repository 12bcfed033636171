"""A run on this machine: the learner in this process, and worker processes (over inproc: threads) that it starts.

Rule: whatever happens, no worker, socket file or temporary folder is left behind.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import zmq

from learner.callbacks.callbacks import Watch
from learner.config.config import Config
from learner.interrupts import Interrupts
from learner.members.process_callbacks import ProcessCallbacks
from learner.resumption import Resumption, unless_finished
from learner.run import Run, RunSetup, describe_over, known_environment, prometheus_observer, run_folder
from millrace.launch.local_worker_options import private_address, stopped_on_error, temporary_keys, worker_flags
from protocol.env_spec import EnvSpec
from protocol.errors import UsageError
from protocol.keys.keys import Token
from protocol.wire.learner_link import LearnerLink
from workers.supervise.worker_process import WorkerCommand, WorkerProcess
from workers.supervise.worker_thread import WorkerThread
from workers.supervisor import STOP_WITHIN_S, Running, Supervisor


def train(config: Config, resume: Path | None, watch: Watch, env: EnvSpec | None = None) -> Path:
    """Train. Returns the run folder. `env`: the environment, if the settings do not name one that workers find.

    Raises `UserFacingError`, or `Interrupted` if the user stopped the run.
    """
    return unless_finished(config, resume, lambda checked: _train(config, checked, watch, env))


def _train(config: Config, resume: Resumption | None, watch: Watch, env: EnvSpec | None) -> Path:
    env = env or EnvSpec.of(config.env, config.env_kwargs, config.wrapper)
    if config.inference == "learner":
        from millrace.launch import learner_inference as inference

        return inference.train(config, resume, watch, env)
    keyring, token = temporary_keys(config.transport, config.keys, insecure=config.insecure)
    if env.factory is not None and config.transport == "tcp" and keyring is None:
        raise UsageError("an environment factory is code: it travels over ipc or inproc only, or over tcp with --keys")
    with ExitStack() as stack:
        address = private_address(config.transport, stack)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        link = LearnerLink(address, context, keyring)
        stack.callback(link.close, 0.5)
        observer = stack.enter_context(prometheus_observer(config))
        folder = stack.enter_context(run_folder(config, resume))
        start = _starter(config, link.address, token, context, folder.path)
        supervisor = Supervisor(start, config.workers, timeouts=config.call_timeouts())
        interrupts = Interrupts(config.grace_s)
        stack.callback(lambda: supervisor.stop(interrupts.at_most(STOP_WITHIN_S)))
        processes = ProcessCallbacks(supervisor.poll, supervisor.activities, expected=config.workers)
        with stopped_on_error(supervisor):
            known = known_environment(config, env, resume, describe_over(link, config, processes))
        run = Run(RunSetup(config, known, folder, resume is not None, interrupts), link, processes, watch, observer)
        run.train(config.min_workers or config.workers)
        return run.folder.path


def _starter(
    config: Config, address: str, token: Token | None, context: zmq.Context[zmq.Socket[bytes]], run: Path
) -> Callable[[str], Running]:
    if config.transport == "inproc":
        return lambda name: WorkerThread(address, name, context)
    flags = worker_flags(config, run)

    def start(name: str) -> WorkerProcess:
        own, log = flags(name)
        return WorkerProcess(WorkerCommand(address, name, log, token, own))

    return start
