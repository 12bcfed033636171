"""The lobby: the workers of a learner join here before its run begins, and one describes the environment. A shell.

Rule: every wait has a deadline, and the log says what is awaited. The run's hub takes over the link, and the workers with
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
    """The settings of a run that matter before it begins, named as in `Config`."""

    wait: WaitSpec
    """The content of the Welcome to waiting workers."""
    worker_timeout_s: float
    no_workers_timeout_s: float
    stall_timeout_s: float
    max_env_failures: int
    progress: RunProgress = field(default_factory=RunProgress)
    """How far the run has got. A resumed run doesn't begin at 0."""
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
        """the number of the first session; the run continues to count from here"""
        self.described_in_s = 0.0
        """seconds that the longest `describe` took. A later one may end while another worker is still busy with this one."""
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
        """Wait for a worker to describe the environment. Returns the first description that is accepted.

        `check_interrupt` is called at least every 0.1 s, and an exception that it raises ends the wait.

        Raises `UsageError` if a worker started by this program, or each of `launched_workers`, reports that there is no such
        environment or gives a description that is not accepted. Raises `EnvironmentFailed` if the environment fails too
        often, and `NoWorkers` or `Stalled` if a deadline passes. Neither time without workers nor time in the
        environment's code is a stall. Time without workers isn't part of `described_in_s` either.
        """
        coordinator = self._coordinator
        server = self._server
        stall_timeout_s = self._settings.stall_timeout_s
        members = coordinator.members
        began_s = self._clock()  # since then, there has always been a worker that could describe the environment
        looked_s = counted_s = began_s  # `counted_s` moves on with the time that doesn't count as a stall
        wait = LongWait(began_s)
        wait_for_answer = LongWait(began_s)
        server.send(coordinator.ask(unknown))
        while coordinator.described is None:
            server.listen(POLL_S)
            check_interrupt()
            self._check()
            now = self._clock()
            # Time in the environment's code doesn't count, because those calls have their own timeouts, with better errors.
            counted_s = max([counted_s, *(member.in_env_code_s for member in members.values())])
            if not members:
                counted_s += now - looked_s
                began_s = now
                wait_for_answer = LongWait(now)
            looked_s = now
            if now - counted_s > stall_timeout_s:
                told = server.what_workers_do()
                raise Stalled(f"no description of the environment within {stall_timeout_s:.0f} s; {told}")
            if wait.due(now):
                log.warning("no env steps for %.0f s: %s", wait.seconds(now), server.what_workers_do())
            if wait_for_answer.due(now):
                server.send(coordinator.ask_more())
        self.described_in_s = max(self.described_in_s, self._clock() - began_s)
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
        """Count failures. None of them occurs after env steps, so there is no line to log."""
        self._failures.count(event, self._clock())

    def sent(self, peer: bytes) -> None:
        """Called when a message was sent. Does nothing."""

    def listen(self) -> None:
        """Answer the workers while the learner prepares the run. If none can take part, raises what `describe` raises."""
        self._server.listen(0.0)
        self._check()

    def hand_over(self) -> Membership:
        """Close the lobby. Returns the workers waiting for the run, for its hub to take over."""
        self._server.listen(0.0)  # first, because the hub must not take over ended or revoked workers
        self._server.close()
        return self._coordinator.membership

    def _check(self) -> None:
        """Raise an error if there were too many failures, if the environment is unsuitable, or if there is no worker."""
        self._failures.check()
        if self._coordinator.unsuitable is not None:
            raise self._coordinator.unsuitable
        self._server.check_members(self._settings.no_workers_timeout_s)
