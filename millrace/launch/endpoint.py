"""The address, keys and socket of a learner that starts local workers, or lets workers elsewhere join.

Rule: whatever happens, closing `resources` releases all that was acquired.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass

from learner.members.bound import Bound, bind, listen
from learner.members.endpoint import BindSettings
from millrace.launch.local_worker_options import WorkerFlags, private_address, temporary_keys
from protocol.keys.keys import Token
from protocol.wire.shared_memory import InheritedDescriptors
from workers.supervise.supervisor import Running
from workers.supervise.worker_process import WorkerCommand, WorkerProcess
from workers.worker_thread import WorkerThread


def _nothing_handed(name: str) -> InheritedDescriptors | None:
    return None


@dataclass(frozen=True)
class Endpoint(Bound):
    """An address that is bound, and what a worker needs to join there."""

    token: Token | None
    """Token of local workers."""

    def starter(
        self, flags: WorkerFlags, handed: Callable[[str], InheritedDescriptors | None] = _nothing_handed
    ) -> Callable[[str], Running]:
        """A function that starts the local worker of a name: a thread if the address is inproc, else a process.

        `flags` and `handed`: its flags and log, and the file descriptors that it inherits, by its name.
        """
        if self.link.address.startswith("inproc://"):
            return lambda name: WorkerThread(self.link.address, name, self.context)

        def start(name: str) -> WorkerProcess:
            own, log_file = flags(name)
            return WorkerProcess(WorkerCommand(self.link.address, name, log_file, self.token, own, handed(name)))

        return start


def open_endpoint(where: BindSettings, transport: str, resources: ExitStack, code: str = "") -> Endpoint:
    """Bind `where.bind`, or without one an address of this transport for local workers.

    `code`: as of `learner.members.bound.bind`. Raises `UsageError`.
    """
    if where.bind:
        token, bound = None, listen(where, resources, code)
    else:
        keyring, token = temporary_keys(transport, where.keys, insecure=where.insecure)
        bound = bind(private_address(transport, resources), keyring, resources, code)
    return Endpoint(bound.link, bound.context, bound.keyring, token)
