"""Opens the learner's end of the conversation: address, keys and socket, and starts local workers for it.

Rule: code travels only over ipc, inproc, or tcp with keys. Closing `resources` releases all that was acquired.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime

import zmq

from learner.members.endpoint import BindSettings, join_lines, keyring_for
from millrace.launch.local_worker_options import WorkerFlags, private_address, temporary_keys
from protocol.errors import UsageError
from protocol.keys.key_folder import Keyring
from protocol.keys.keys import Token
from protocol.wire.learner_link import LearnerLink
from protocol.wire.shared_memory import InheritedDescriptors
from workers.supervise.worker_process import WorkerCommand, WorkerProcess
from workers.supervise.worker_thread import WorkerThread
from workers.supervisor import Running

log = logging.getLogger("millrace.learner")


def _nothing_handed(name: str) -> InheritedDescriptors | None:
    return None


@dataclass(frozen=True)
class Endpoint:
    """An address that is bound, and what a worker needs to join there."""

    link: LearnerLink
    context: zmq.Context[zmq.Socket[bytes]]
    keyring: Keyring | None
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

    def announce(self, advertise: str) -> None:
        """Log how a worker is started elsewhere."""
        for line in join_lines(self.link.address, advertise, self.keyring):
            log.warning("%s", line)


def open_endpoint(where: BindSettings, transport: str, resources: ExitStack, code: str = "") -> Endpoint:
    """Bind `where.bind`, or without one an address of this transport for local workers.

    `code`: what travels to the workers as code, for the error; empty if nothing does. Raises `UsageError`.
    """
    if where.bind:
        keyring, token = keyring_for(where, datetime.now(UTC).replace(microsecond=0)), None
        address = where.bind
    else:
        keyring, token = temporary_keys(transport, where.keys, insecure=where.insecure)
        address = private_address(transport, resources)
    if code and address.startswith("tcp://") and keyring is None:
        raise UsageError(f"{code} is code: it travels over ipc or inproc only, or over tcp with keys")
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    resources.callback(context.term)
    link = LearnerLink(address, context, keyring)
    resources.callback(link.close, 0.5)
    return Endpoint(link, context, keyring, token)
