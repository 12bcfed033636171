"""The pool of workers of a learner: they are started here, or join from elsewhere.

The order is: open the pool, which binds its address; make or open the folder that the workers write to; `start` the workers,
or log how to start one elsewhere; let a worker in the lobby describe the environment; `begin` with the workers that collect.

Rule: whatever happens, no worker or thread outlives `start`, and no socket file or folder outlives the pool. Workers that
still run at the end of `start` are stopped at once. So code that lets them work calls `stop` first, with the time that they
may take.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import Protocol

from millrace.launch.crew import Crew
from millrace.launch.private_address import private_address
from millrace.learner.members.bound import Bound, bind, listen
from millrace.learner.members.lobby import Lobby, LobbySettings
from millrace.learner.members.who_may_connect import BindSettings, generate_run_keys
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.keys.key_folder import Keyring, chosen_key_folder
from millrace.protocol.keys.keys import Token
from millrace.protocol.messages import Status
from millrace.workers.machine_slots import copies_per_machine
from millrace.workers.supervise.supervisor import Running, Supervisor
from millrace.workers.supervise.worker_process import WorkerCommand, WorkerProcess
from millrace.workers.worker_thread import WorkerThread

STOP_BEFORE_RUN_S = 0.5  # if no run has begun: a worker in the constructor of its environment doesn't listen


class WorkerPool(Protocol):
    """The workers of a learner. The policy acts in them, or in this process (`learner_inference.py`)."""

    @property
    def bound(self) -> Bound:
        """The address where workers join, and who may."""
        ...

    def start(self, crew: Crew, before: LobbySettings) -> AbstractContextManager[Lobby]:
        """The lobby of these workers, which are started, or join from elsewhere.

        Call it once. `before`: settings until the run begins.
        """
        ...

    def begin(self, described: DescribedEnv, *, masked: bool) -> Lobby:
        """Let the run begin.

        Returns the lobby of the workers that collect for it. Call it once. `described`: the environment as a worker in the
        first lobby described it. `masked`: whether masks are used.
        """
        ...

    def report(self, status: Callable[[float], Status]) -> None:
        """Answer `millrace status` with the run's status from now on."""
        ...

    def stop(self, within_s: float) -> None:
        """Ask all local workers and threads to leave, and end those that still run after this time."""
        ...


@dataclass
class ActingPool:
    """A pool whose workers act."""

    bound: Bound
    where: BindSettings
    """Where workers from elsewhere join, if they do."""
    token: Token | None
    """Token of local workers."""
    processes: WorkerProcesses = field(default_factory=WorkerProcesses)
    """The workers that were started here."""
    lobby: Lobby | None = None
    """Their lobby, once they were started."""

    @contextmanager
    def start(self, crew: Crew, before: LobbySettings) -> Iterator[Lobby]:
        """The lobby of the workers. None is started here if they join at `where`."""
        if self.where.bind:
            self.bound.announce(self.where.advertise)
        else:
            self.processes = _LocalProcesses(crew, partial(_started, self.bound, self.token, crew))
        self.lobby = Lobby(self.bound.link, self.processes, before)
        try:
            yield self.lobby
        finally:
            self.stop(STOP_BEFORE_RUN_S)

    def begin(self, described: DescribedEnv, *, masked: bool) -> Lobby:
        """The same lobby: these workers collect."""
        assert self.lobby is not None, "start comes first"
        return self.lobby

    def report(self, status: Callable[[float], Status]) -> None:
        """Do nothing: the hub of the run answers at this address."""

    def stop(self, within_s: float) -> None:
        """Stop the workers that were started here."""
        self.processes.stop(within_s)


def _started(bound: Bound, token: Token | None, crew: Crew, name: str) -> Running:
    """A worker of this crew: a thread of this process if the address is within it, else a process."""
    address = bound.link.address
    if address.startswith("inproc://"):
        return WorkerThread(address, name, bound.context, evaluates=crew.evaluates(name))
    inherited = crew.descriptors_of(name) or ()
    return WorkerProcess(WorkerCommand(address, name, crew.log_of(name), token, crew.flags_of(name), inherited))


@contextmanager
def open_worker_pool(where: BindSettings, transport: str, code: str = "") -> Iterator[ActingPool]:
    """Bind `where.bind`, or if it is empty an address of this transport for local workers.

    `code`: see `millrace.learner.members.bound.bind`. Raises `UsageError`.
    """
    with ExitStack() as resources:
        if where.bind:
            token = None
            bound = listen(where, resources, code)
        else:
            keyring, token = _temporary_keys(transport, where.keys, insecure=where.insecure)
            bound = bind(private_address(transport, resources), keyring, resources, code)
        yield ActingPool(bound, where, token)


def _temporary_keys(transport: str, keys: str, *, insecure: bool) -> tuple[Keyring | None, Token | None]:
    """Keys for this run only, if it uses TCP and a key folder was named; else None."""
    encrypted = transport == "tcp" and chosen_key_folder(keys) is not None and not insecure
    return generate_run_keys("local", datetime.now(UTC)) if encrypted else (None, None)


class _LocalProcesses(WorkerProcesses):
    """The processes or threads of a crew."""

    def __init__(self, crew: Crew, start: Callable[[str], Running]) -> None:
        """Starts them all. `start`: starts the worker of this name."""
        self.expected = crew.count
        self.most_copies = copies_per_machine() if crew.count else 0
        self._crew = crew
        self._supervisor = Supervisor(start, crew.count)

    def ended(self) -> Sequence[WorkerExit | StartFailed]:
        return self._supervisor.poll()

    def activities(self) -> Sequence[WorkerActivity]:
        return self._supervisor.activities()

    def last_lines(self) -> Mapping[str, str]:
        return self._supervisor.said()

    def left(self, *, collecting: bool) -> float:
        if not self.expected:  # no local ones were requested: others join
            return math.inf
        return sum(not (collecting and self._crew.evaluates(name)) for name in self._supervisor.names)

    def kill(self, worker: str) -> bool:
        return self._supervisor.kill(worker)

    def stop(self, timeout_s: float) -> None:
        self._supervisor.stop(timeout_s)

    def lower_priority(self) -> None:
        self._supervisor.lower_priority()
