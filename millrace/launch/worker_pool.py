"""The pool of a learner's workers, which are started on this machine or join from elsewhere.

The order is: open the pool, which binds its address; make or open the folder to which workers write; `start` the workers, or
log how to start one elsewhere; let a worker in the lobby describe the environment; `begin` with the workers that collect.

Rule: whatever happens, no worker or thread outlives the context of `start`, and no socket file or folder outlives the pool.
Workers still running when the context of `start` exits are stopped almost at once. To give them time to finish their work,
call `stop` first.
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import Protocol

from millrace.launch.crew import Crew
from millrace.launch.private_address import private_address
from millrace.launch.waiting_steps import SeenWorker, WaitingSteps
from millrace.learner.members.bound import Bound, bind, listen
from millrace.learner.members.lobby import Lobby, LobbySettings
from millrace.learner.members.who_may_connect import BindSettings, generate_run_keys
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.keys.key_folder import Keyring, chosen_key_folder
from millrace.protocol.keys.keys import Token
from millrace.protocol.logs.notices import log_notice
from millrace.protocol.machine.available_memory import available_bytes
from millrace.protocol.machine.core_times import core_times
from millrace.protocol.messages import Status
from millrace.workers.machine_slots import copies_per_machine
from millrace.workers.supervise.supervisor import Running, Supervisor
from millrace.workers.supervise.worker_process import WorkerCommand, WorkerProcess
from millrace.workers.worker_thread import WorkerThread

log = logging.getLogger("millrace.learner")

STOP_BEFORE_RUN_S = 0.5  # short, because a worker that is still constructing its environment can't answer anyway


class WorkerPool(Protocol):
    """The workers of a learner. The policy acts in these workers, or in this process (`learner_inference.py`)."""

    @property
    def bound(self) -> Bound:
        """The address where workers join, and which workers may join."""
        ...

    def start(self, crew: Crew, before: LobbySettings) -> AbstractContextManager[Lobby]:
        """Start the workers of this crew, or let workers join from elsewhere. Call it once.

        Returns a context manager: the lobby of the workers. `before`: settings that apply until the run begins.
        """
        ...

    def begin(self, described: DescribedEnv) -> Lobby:
        """Begin the run. Call it once.

        Returns the lobby of the workers that collect rollouts for the run. `described`: the environment, as a worker in the
        lobby of `start` described it.
        """
        ...

    def report(self, status: Callable[[float], Status]) -> None:
        """From now on, answer `millrace status` with what `status` returns. `status` is called with the current time."""
        ...

    def stop(self, within_s: float) -> None:
        """Ask all local workers and threads to leave, and end those still running after `within_s`."""
        ...


@dataclass
class ActingPool:
    """A pool whose workers act with the policy themselves."""

    bound: Bound
    where: BindSettings
    """Where workers from elsewhere join; without a bind address, local workers are started."""
    token: Token | None
    """Token with which local workers join, if keys are used."""
    processes: WorkerProcesses = field(default_factory=WorkerProcesses)
    """The local workers."""
    lobby: Lobby | None = None
    """The lobby of the workers, after `start`."""

    @contextmanager
    def start(self, crew: Crew, before: LobbySettings) -> Iterator[Lobby]:
        """A context manager that starts the local workers, unless workers join from elsewhere, and yields the lobby."""
        if self.where.bind:
            self.bound.announce(self.where.advertise)
        else:
            self.processes = _LocalProcesses(crew, partial(_started, self.bound, self.token, crew))
        self.lobby = Lobby(self.bound.link, self.processes, before)
        try:
            yield self.lobby
        finally:
            self.stop(STOP_BEFORE_RUN_S)

    def begin(self, described: DescribedEnv) -> Lobby:
        """Returns the lobby of `start`, because its workers also collect."""
        assert self.lobby is not None, "start comes first"
        return self.lobby

    def report(self, status: Callable[[float], Status]) -> None:
        """Do nothing, because the run's hub answers `millrace status` at this address."""

    def stop(self, within_s: float) -> None:
        """Stop the local workers."""
        self.processes.stop(within_s)


def _started(bound: Bound, token: Token | None, crew: Crew, name: str) -> Running:
    """Start the worker with this name: a thread if the address is within this process, otherwise a process."""
    address = bound.link.address
    if address.startswith("inproc://"):
        return WorkerThread(address, name, bound.context, evaluates=crew.evaluates(name))
    inherited = crew.descriptors_of(name) or ()
    return WorkerProcess(WorkerCommand(address, name, crew.log_of(name), token, crew.flags_of(name), inherited))


@contextmanager
def open_worker_pool(where: BindSettings, transport: str, code: str = "") -> Iterator[ActingPool]:
    """A context manager that binds `where.bind` or, if that is empty, an address of this transport for local workers.

    `code`: see `millrace.learner.members.bound.bind`. Raises `UsageError` if the address can't be bound.
    """
    owner = os.getpid()
    resources = ExitStack()
    try:
        if where.bind:
            token = None
            bound = listen(where, resources, code)
        else:
            keyring, token = _temporary_keys(transport, where.keys, insecure=where.insecure)
            bound = bind(private_address(transport, resources), keyring, resources, code)
        yield ActingPool(bound, where, token)
    finally:
        if os.getpid() == owner:  # a forked child that ends must not remove the socket on which this process listens
            resources.close()


def _temporary_keys(transport: str, keys: str, *, insecure: bool) -> tuple[Keyring | None, Token | None]:
    """Keys for this run only, if local workers use TCP and a key folder was chosen; otherwise None."""
    encrypted = transport == "tcp" and chosen_key_folder(keys) is not None and not insecure
    return generate_run_keys("local", datetime.now(UTC)) if encrypted else (None, None)


class _LocalProcesses(WorkerProcesses):
    """The processes or threads of a crew."""

    def __init__(self, crew: Crew, start: Callable[[str], Running]) -> None:
        """Start all workers of the crew. `start` starts the worker of a given name."""
        self.expected = crew.count
        self.most_copies = copies_per_machine() if crew.count else 0
        self._crew = crew
        self._supervisor = Supervisor(start, crew.count)
        self._waiting_steps = WaitingSteps(crew.collecting, crew.lanes, crew.envs)

    def ended(self) -> Sequence[WorkerExit | StartFailed]:
        if self._waiting_steps.is_due(time.monotonic()):
            self._look_whether_steps_wait()
        return self._supervisor.poll()

    def _look_whether_steps_wait(self) -> None:
        began_s = time.monotonic()
        used = self._supervisor.used()
        running = (each for each in self._supervisor.activities() if each.worker in used)
        seen = [SeenWorker(each.doing, used[each.worker]) for each in running]
        cores = core_times()
        if line := self._waiting_steps.look(seen, cores, available_bytes(), began_s, time.monotonic()):
            log_notice(log, line)

    def activities(self) -> Sequence[WorkerActivity]:
        return self._supervisor.activities()

    def last_lines(self) -> Mapping[str, str]:
        return self._supervisor.said()

    def left(self, *, collecting: bool) -> float:
        if not self.expected:  # no local workers were requested: workers join from elsewhere
            return math.inf
        return sum(not (collecting and self._crew.evaluates(name)) for name in self._supervisor.names)

    def kill(self, worker: str) -> bool:
        return self._supervisor.kill(worker)

    def stop(self, timeout_s: float) -> None:
        self._supervisor.stop(timeout_s)

    def lower_priority(self) -> None:
        self._supervisor.lower_priority()
