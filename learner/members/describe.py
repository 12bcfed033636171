"""Asks workers for the description of the environment, before there is a run. A shell round `DescribeCoordinator`.

Rule: every wait has a deadline and says what it waits for. Afterwards the link is free for the run, and all workers say
Hello again.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass

from millrace.learner.members.describe_coordinator import Accept, DescribeCoordinator, accept_any
from millrace.learner.members.events import Event
from millrace.learner.members.failure_count import FailureCount
from millrace.learner.members.member_server import MemberServer, ServerCallbacks, ServerSettings
from millrace.learner.members.process_callbacks import ProcessCallbacks
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.errors import Stalled
from millrace.protocol.logs.long_wait import LongWait
from millrace.protocol.specs import DescribeSpec
from millrace.protocol.wire.learner_link import LearnerLink

log = logging.getLogger("millrace.learner")

POLL_S = 0.05


@dataclass(frozen=True)
class DescribeSettings:
    """The settings of a run that matter before it begins, named as there."""

    worker_timeout_s: float
    no_workers_timeout_s: float
    stall_timeout_s: float
    max_env_failures: int
    steps: int = 0
    launched_workers: int = 0


def described_by_workers(
    link: LearnerLink,
    spec: DescribeSpec,
    settings: DescribeSettings,
    processes: ProcessCallbacks,
    check_interrupt: Callable[[], None] = lambda: None,
    clock: Callable[[], float] = time.monotonic,
    accept: Accept = accept_any,
) -> DescribedEnv:
    """The environment as the first worker describes it whose description `accept` takes.

    `check_interrupt` is called at least every 0.1 s: what it raises ends the wait. Raises `UsageError` if a worker of this
    program, or each of `settings.launched_workers`, says that there is no such environment, or describes one that is not
    accepted; `EnvironmentFailed` if it fails too often; `NoWorkers` or `Stalled` if a deadline passes.
    """
    coordinator = DescribeCoordinator(
        spec,
        int.from_bytes(os.urandom(6), "little"),
        worker_timeout_s=settings.worker_timeout_s,
        decliners_to_end=1 if processes.expected else settings.launched_workers,
        accept=accept,
    )
    failures = FailureCount(settings.max_env_failures, began_s=clock())
    members = coordinator.membership.members

    def count(event: Event) -> None:
        failures.count(event, clock())  # none comes after env steps, so there is no line to log

    callbacks = ServerCallbacks(
        coordinator.receive,
        lambda now: coordinator.status(settings.steps, now),
        count,
    )
    server_settings = ServerSettings(log_joins=False)
    server = MemberServer(link, coordinator, callbacks, processes, server_settings, clock)
    began_s = clock()
    wait = LongWait(began_s)
    try:
        while coordinator.described is None:
            server.listen(POLL_S)
            check_interrupt()
            failures.check()
            if coordinator.unsuitable is not None:
                raise coordinator.unsuitable
            now = clock()
            server.check_members(settings.no_workers_timeout_s)
            # In environment code, a worker is ended by the timeouts of the calls, which name themselves.
            busy_s = max((member.in_env_code_s for member in members.values()), default=began_s)
            if now - max(began_s, busy_s) > settings.stall_timeout_s and members:
                told = server.what_workers_do()
                raise Stalled(f"no description of the environment within {settings.stall_timeout_s:.0f} s; {told}")
            if wait.due(now):
                log.warning("no env steps for %.0f s: %s", wait.seconds(now), server.what_workers_do())
        server.send(coordinator.finish())
        return coordinator.described
    finally:
        server.close()
