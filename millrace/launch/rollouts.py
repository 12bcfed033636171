"""Start a rollout service: with worker processes on this machine, or with workers that are started elsewhere.

Rule: whatever happens, no worker, socket file or folder of ours is left behind.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime

import zmq

from learner.config.rollout_config import RolloutConfig
from learner.env_spaces import EnvSpaces
from learner.members.describe import described_by_workers
from learner.members.endpoint import join_lines, keyring_for
from learner.members.process_callbacks import ProcessCallbacks
from learner.rollout_service.service import RolloutService, describe_settings, rollout_service
from learner.rollout_service.spec import rollout_spec
from learner.rollouts.ledger import Ledger
from millrace.launch.local_worker_options import private_address, stopped_on_error, temporary_keys, worker_cores
from millrace.policies import PolicyChoice
from protocol.env_spec import EnvSpec
from protocol.envs.description import DescribedEnv
from protocol.errors import UsageError
from protocol.specs import DescribeSpec, RunSpec
from protocol.wire.learner_link import LearnerLink
from workers.supervise.worker_process import WorkerCommand, WorkerProcess
from workers.supervise.worker_thread import WorkerThread
from workers.supervisor import Running, Supervisor, core_flags, timeout_flags

log = logging.getLogger("millrace.learner")


@dataclass(frozen=True)
class StartedService:
    """A service whose workers have joined."""

    service: RolloutService
    run: RunSpec
    described: DescribedEnv


def start(
    config: RolloutConfig,
    env: EnvSpec,
    policy: PolicyChoice,
    rollout_steps: int,
    check_interrupt: Callable[[], None],
    resources: ExitStack,
    *,
    listens: bool,
    past: tuple[Ledger, Sequence[int]] | None = None,
) -> StartedService:
    """Start, and wait until the workers have joined. Closing `resources` releases all that was acquired.

    `listens`: wait for workers elsewhere at `config.bind`, and start none. Raises `UserFacingError`.
    """
    if listens:
        keyring, token = keyring_for(config, datetime.now(UTC).replace(microsecond=0)), None
        address = config.bind
    else:
        keyring, token = temporary_keys(config.transport, config.keys, insecure=config.insecure)
        address = private_address(config.transport, resources)
    if address.startswith("tcp://") and keyring is None and (env.factory is not None or policy.is_code):
        what = "an environment factory" if env.factory is not None else "a policy's callable"
        raise UsageError(f"{what} is code: it travels over ipc or inproc only, or over tcp with keys")
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    resources.callback(context.term)
    link = LearnerLink(address, context, keyring)
    resources.callback(link.close, 0.5)
    supervisor = None
    processes = ProcessCallbacks()
    if listens:
        for line in join_lines(link.address, config.advertise, keyring):
            log.warning("%s", line)
    else:
        cores, timeouts = worker_cores(config), timeout_flags(config.call_timeouts())

        def start_worker(name: str) -> Running:
            if config.transport == "inproc":
                return WorkerThread(link.address, name, context)
            return WorkerProcess(WorkerCommand(link.address, name, None, token, [*timeouts, *core_flags(cores, name)]))

        supervisor = Supervisor(start_worker, config.workers, timeouts=config.call_timeouts())
        resources.callback(supervisor.stop)
        processes = ProcessCallbacks(supervisor.poll, supervisor.activities, expected=config.workers)
    with ExitStack() as starting:
        if supervisor is not None:
            starting.enter_context(stopped_on_error(supervisor))
        spec = DescribeSpec(env, config.chosen_vector(), heartbeat_s=config.heartbeat_s)
        described = described_by_workers(link, spec, describe_settings(config), processes, check_interrupt)
        spaces = EnvSpaces.of_description(described)
        run = rollout_spec(config, env, policy.spec(spaces.observation, spaces.action), rollout_steps, policy.extra_arrays)
        service = rollout_service(config, run, link, processes, check_interrupt, past=past)
        service.wait_for_workers(config.min_workers or (1 if listens else config.workers))
    return StartedService(service, run, described)
