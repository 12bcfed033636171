"""Opens the learner's end of the connection: the socket at its address, with the keys that may connect there.

Rule: code is sent or named only over ipc, over inproc, or over tcp with keys. Closing `resources` releases everything that
was acquired, the socket before its context.
"""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime

import zmq

from millrace.learner.members.who_may_connect import Listening, join_lines, keyring_for
from millrace.protocol.env_spec import FACTORY, REGISTER_IT
from millrace.protocol.errors import UsageError
from millrace.protocol.keys.key_folder import Keyring
from millrace.protocol.logs.notices import log_notice
from millrace.protocol.machine.deferred_signals import signals_deferred
from millrace.protocol.machine.open_files import raise_limit
from millrace.protocol.wire.learner_link import LearnerLink

log = logging.getLogger("millrace.learner")

LINGER_S = 0.5  # how long a closed socket still tries to send queued messages
LINGER_ELSEWHERE_S = 2.0  # the same, if workers are started elsewhere, perhaps on other machines


@dataclass(frozen=True)
class Bound:
    """A bound address, with the keys that may connect there."""

    link: LearnerLink
    context: zmq.Context[zmq.Socket[bytes]]
    keyring: Keyring | None
    """The keys that may connect; None if no key is needed."""

    def announce(self, advertise: str) -> None:
        """Log how to start a worker on another machine."""
        for line in join_lines(self.link.address, advertise, self.keyring):
            log_notice(log, line)


def listen(where: Listening, resources: ExitStack, code: str = "") -> Bound:
    """Bind `where.bind` for workers that are started elsewhere. For `code` and errors, see `bind`."""
    raise_limit()
    keyring = keyring_for(where, datetime.now(UTC).replace(microsecond=0), calls_code=bool(code))
    return bind(where.bind, keyring, resources, code, LINGER_ELSEWHERE_S)


def bind(address: str, keyring: Keyring | None, resources: ExitStack, code: str = "", linger_s: float = LINGER_S) -> Bound:
    """Bind this address for peers whose keys are in `keyring`.

    `code` names, for error messages, the code that workers must call; it is empty if there is none. Raises `UsageError` if
    there is code and an address of tcp without keys, or if the address can't be bound.
    """
    if code and address.startswith("tcp://") and keyring is None:
        instead = REGISTER_IT if code == FACTORY else ""
        raise UsageError(f"{code} is code: it travels over ipc or inproc only, or over tcp with keys{instead}")
    with signals_deferred():  # a socket that nobody closes would make `context.term` wait forever
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        resources.callback(context.term)
        link = LearnerLink(address, context, keyring)
        resources.callback(link.close, linger_s)
    return Bound(link, context, keyring)
