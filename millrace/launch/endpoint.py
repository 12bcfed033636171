"""The address, keys and socket of a learner, and its workers: they are started here, or join from elsewhere.

Rule: whatever happens, closing `resources` releases all that was acquired, and no worker outlives `Endpoint.workers`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import NamedTuple

from millrace.launch.local_worker_options import FlagsOfWorker, temporary_keys
from millrace.launch.private_address import private_address
from millrace.learner.members.bound import Bound, bind, listen
from millrace.learner.members.process_callbacks import ProcessCallbacks
from millrace.learner.members.who_may_connect import BindSettings
from millrace.protocol.keys.keys import Token
from millrace.protocol.wire.shared_memory import InheritedDescriptors
from millrace.workers.conversation.connection_rules import LEARNER_STARTED_IT_S
from millrace.workers.machine_slots import copies_per_machine
from millrace.workers.supervise.supervisor import STOP_WITHIN_S, Running, Supervisor
from millrace.workers.supervise.worker_process import WorkerCommand, WorkerProcess
from millrace.workers.worker_thread import WorkerThread


class StartedWorkers(NamedTuple):
    """The workers that were started here: none if they join from elsewhere."""

    supervisor: Supervisor
    processes: ProcessCallbacks


@dataclass(frozen=True)
class Endpoint(Bound):
    """An address that is bound, and what a worker needs to join there."""

    token: Token | None
    """Token of local workers."""
    where: BindSettings
    """Where workers from elsewhere join, if they do."""

    @contextmanager
    def workers(
        self,
        count: int,
        flags: FlagsOfWorker,
        stop_within_s: float = STOP_WITHIN_S,
        handed: Callable[[str], InheritedDescriptors | None] = lambda name: None,
        evaluating: int = 0,
    ) -> Iterator[StartedWorkers]:
        """Start `count` workers here; or, if they join from elsewhere, start none, and log how one joins.

        The last `evaluating` of them only evaluate.

        A worker is a thread if the address is inproc, else a process. `flags` and `handed`: its flags and log, and the file
        descriptors that it inherits, by its name. At the end, workers that still run are asked to leave, and killed after
        `stop_within_s`.
        """

        def evaluates(name: str) -> bool:
            return int(name.removeprefix("w")) >= count - evaluating

        def left(collecting: bool) -> float:
            if not count:  # they join from elsewhere
                return math.inf
            return sum(not (collecting and evaluates(name)) for name in supervisor.names)

        def start(name: str) -> Running:
            if self.link.address.startswith("inproc://"):
                return WorkerThread(self.link.address, name, self.context, evaluates=evaluates(name))
            own, log_file = flags(name)
            own = [*own, "--join-timeout-s", str(LEARNER_STARTED_IT_S), *(["--evaluate"] if evaluates(name) else [])]
            if (descriptors := handed(name)) is not None:
                own = [*own, "--handed", ",".join(map(str, descriptors))]
            return WorkerProcess(WorkerCommand(self.link.address, name, log_file, self.token, own, descriptors or ()))

        if self.where.bind:
            count = 0
            self.announce(self.where.advertise)
        supervisor = Supervisor(start, count)
        processes = ProcessCallbacks(
            supervisor.poll,
            supervisor.activities,
            supervisor.said,
            left=left,
            lower_priority=supervisor.lower_priority,
            expected=count,
            most_copies=copies_per_machine() if count else 0,
        )
        try:
            yield StartedWorkers(supervisor, processes)
        finally:
            supervisor.stop(stop_within_s)


def open_endpoint(where: BindSettings, transport: str, resources: ExitStack, code: str = "") -> Endpoint:
    """Bind `where.bind`, or without one an address of this transport for local workers.

    `code`: as of `millrace.learner.members.bound.bind`. Raises `UsageError`.
    """
    if where.bind:
        token = None
        bound = listen(where, resources, code)
    else:
        keyring, token = temporary_keys(transport, where.keys, insecure=where.insecure)
        bound = bind(private_address(transport, resources), keyring, resources, code)
    return Endpoint(bound.link, bound.context, bound.keyring, token, where)
