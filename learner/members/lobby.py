"""The workers of a learner before its run begins: they join here, and one describes the environment. A shell.

Rule: every wait has a deadline and says what it waits for. The hub of the run takes over the link, and the workers with
their sessions.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from msgspec.structs import replace

from millrace.learner.members.describe_coordinator import DescribeCoordinator, Unknown
from millrace.learner.members.events import Event
from millrace.learner.members.failure_count import FailureCount
from millrace.learner.members.member import Member
from millrace.learner.members.member_server import MemberServer, ServerSettings
from millrace.learner.members.membership import Membership
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.errors import Stalled
from millrace.protocol.logs.long_wait import LongWait
from millrace.protocol.messages import Status
from millrace.protocol.progress import RunProgress
from millrace.protocol.specs import WaitSpec
from millrace.protocol.wire.learner_link import LearnerLink

log = logging.getLogger("millrace.learner")

POLL_S = 0.05


@dataclass(frozen=True)
class LobbySettings:
    """The settings of a run that matter before it begins, with the names that they have in `Config`."""

    wait: WaitSpec
    """What a Welcome to waiting workers says."""
    worker_timeout_s: float
    no_workers_timeout_s: float
    stall_timeout_s: float
    max_env_failures: int
    progress: RunProgress = field(default_factory=RunProgress)
    """How far the run is: a resumed run doesn't begin at 0."""
    launched_workers: int = 0


def _never() -> None: ...


class Lobby:
    """A link, the worker processes that this program started, and the workers that have joined."""

    def __init__(
        self,
        link: LearnerLink,
        processes: WorkerProcesses,
        settings: LobbySettings,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.link = link
        self.processes = processes
        self.first_session = int.from_bytes(os.urandom(6), "little")
        """also of the run, which continues its counts"""
        self._settings = settings
        self._clock = clock
        coordinator = self._coordinator = DescribeCoordinator(
            settings.wait,
            self.first_session,
            worker_timeout_s=settings.worker_timeout_s,
            decliners_to_end=1 if processes.expected else settings.launched_workers,
        )
        self._failures = FailureCount(settings.max_env_failures, began_s=clock())
        self._server = MemberServer(link, coordinator, self, processes, ServerSettings(log_joins=False), clock)

    def describe(self, unknown: Unknown, check_interrupt: Callable[[], None] = _never) -> DescribedEnv:
        """The environment, from the first description by a worker that is accepted.

        `check_interrupt` is called at least every 0.1 s: what it raises ends the wait. Raises `UsageError` if a worker of
        this program, or each of `launched_workers`, says that there is no such environment, or describes one that is not
        accepted; `EnvironmentFailed` if it fails too often; `NoWorkers` or `Stalled` if a deadline passes.
        """
        coordinator = self._coordinator
        server = self._server
        stall_timeout_s = self._settings.stall_timeout_s
        members = coordinator.members
        began_s = self._clock()
        wait = LongWait(began_s)
        server.send(coordinator.ask(unknown))
        while coordinator.described is None:
            server.listen(POLL_S)
            check_interrupt()
            self._check()
            now = self._clock()
            # In environment code, the timeouts of calls end a worker, and their errors name them.
            busy_s = max((member.in_env_code_s for member in members.values()), default=began_s)
            if now - max(began_s, busy_s) > stall_timeout_s and members:
                told = server.what_workers_do()
                raise Stalled(f"no description of the environment within {stall_timeout_s:.0f} s; {told}")
            if wait.due(now):
                log.warning("no env steps for %.0f s: %s", wait.seconds(now), server.what_workers_do())
                server.send(coordinator.ask_more())
        return coordinator.described

    def status(self, now: float) -> Status:
        """The answer to `millrace status`."""
        doing = self._server.what_workers_do()
        if self._coordinator.described is not None:
            waiting = "preparing the run"
        elif self._coordinator.members:
            waiting = f"waiting for a description of the environment: {doing}"
        else:
            waiting = doing
        progress = replace(
            self._settings.progress,
            workers_alive=len(self._coordinator.members),
            workers_expected=self.processes.expected,
            phase="starting",
            waiting=one_line(waiting),
        )
        return self._coordinator.status(progress, now)

    def happened(self, event: Event) -> None:
        """Count failures. None comes after env steps, so there is no line to log."""
        self._failures.count(event, self._clock())

    def sent(self, peer: bytes) -> None:
        """Do nothing when a message was sent."""

    def listen(self) -> None:
        """Answer the workers while the learner prepares the run. Raises like `describe` if none can take part in it."""
        self._server.listen(0.0)
        self._check()

    def hand_over(self) -> Membership[Member]:
        """Begin the run. Returns the workers that wait for it: the run's hub takes them over."""
        self._server.listen(0.0)  # so that it takes over nobody whose process has ended, or whose key was revoked meanwhile
        self._server.close()
        return self._coordinator.membership

    def _check(self) -> None:
        """Raise what ends the start: too many failures, an environment that does not suit, or no worker."""
        self._failures.check()
        if self._coordinator.unsuitable is not None:
            raise self._coordinator.unsuitable
        self._server.check_members(self._settings.no_workers_timeout_s)
