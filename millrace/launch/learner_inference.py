"""Run with `--inference learner`: workers only step env copies; the policy acts in this process, for all copies at once.

The learner collects from a single worker, which is a thread of this process. The env copies of this worker belong to a
vector environment, whose workers are processes. So tickets, ledger, rows, checkpoints and errors are those of every run, and
a lane gets the same seeds and random numbers as with `--inference workers`.

Rule: whatever happens, no worker, thread, socket file or folder of ours is left behind.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from millrace.launch.acting_thread import NEVER_S, acting_processes, acting_thread, lanes_of
from millrace.launch.endpoint import open_endpoint
from millrace.launch.local_worker_options import worker_flags
from millrace.launch.vector import listen
from millrace.learner.callbacks.callbacks import Watch
from millrace.learner.config.config import Config
from millrace.learner.config.validation import workers_to_wait_for
from millrace.learner.conversations import lobby_settings
from millrace.learner.interrupts import Interrupts
from millrace.learner.members.lobby import Lobby
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.resume_checks import Resumption
from millrace.learner.run_setup import RunSetup, known_environment, prometheus_observer, run_folder
from millrace.learner.torch_setup import one_thread, torch_device
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.env_spec import EnvSpec
from millrace.workers.supervise.supervisor import STOP_WITHIN_S


def train(
    config: Config,
    resume: Resumption | None,
    watch: Watch,
    env_spec: EnvSpec,
    *,
    elsewhere: bool = False,
) -> Path:
    """Train until the run is done. Returns the run folder.

    `elsewhere`: the workers are started elsewhere and join at `config.bind`. Raises `UserFacingError`, or `Interrupted` if
    the user stopped the run.
    """
    workers = workers_to_wait_for(config, None if elsewhere else min(config.workers, config.envs))
    with ExitStack() as stack:
        endpoint = open_endpoint(BindSettings(), "inproc", stack)
        listening = listen(_settings(config, env_spec, elsewhere=elsewhere), stack.enter_context(ExitStack()))
        observer = stack.enter_context(prometheus_observer(config))
        folder = stack.enter_context(run_folder(config, resume))
        started = listening.start(worker_flags(config, folder.path), lobby_settings(config, config.steps))
        known = known_environment(config, env_spec, resume, started.lobby)
        env = started.vector_env(known.described)
        stack.callback(env.close)
        masked, timeout_s = known.spaces.masked, config.no_workers_timeout_s
        lanes = lanes_of(env, config.lanes, config.info_keys, workers, timeout_s, masked=masked)
        thread = acting_thread(endpoint, lanes, lanes.evaluation_lane(config.eval_copies), lambda: torch_device(config))
        interrupts = Interrupts(config.grace_s)
        stack.callback(lambda: thread.stop(interrupts.at_most(STOP_WITHIN_S)))
        stack.callback(thread.ask_to_leave)  # if it is asked a second time, the worker leaves at once
        processes = acting_processes(thread, lanes, env, 0 if elsewhere else config.workers)
        from millrace.learner.run import open_run  # imports PyTorch, which was done while a worker described the environment

        with interrupts, one_thread():
            setup = RunSetup(config, known, folder, resume is not None, interrupts, elsewhere)
            lobby = Lobby(endpoint.link, processes, lobby_settings(config, config.steps))
            run = open_run(setup, lobby, watch, observer)
            # The learner's own endpoint is inproc: `millrace status` asks where the workers join.
            env.hub.status_of_run = run.hub.status
            run.announce(env.address, config.advertise, listening.endpoint.keyring)
            run.train(1)
        return folder.shown


def _settings(config: Config, env: EnvSpec, *, elsewhere: bool) -> VectorEnvSettings:
    """The vector environment of a run; `elsewhere`: its workers are started elsewhere."""
    return VectorEnvSettings(
        env,
        config.envs,
        workers=None if elsewhere else config.workers,
        lanes=config.lanes,
        listen=BindSettings(config.bind if elsewhere else "", config.keys, config.insecure, config.advertise),
        transport=config.transport,
        timeout_s=_longest_order_s(config),
        worker_timeout_s=config.worker_timeout_s,
        call_timeouts=config.call_timeouts(),
        copy=False,
        single_lanes=config.eval_copies,
    )


def _longest_order_s(config: Config) -> float:
    """How long an order may take: to make and to reset every copy. A worker whose environment hangs is ended before that."""
    timeouts = config.call_timeouts()
    each_s = 2 * timeouts.start_s + timeouts.step_s
    return each_s * config.envs if timeouts.start_s and timeouts.step_s else NEVER_S
