"""Explains failed handshakes, from the events of libzmq's monitor. Pure, except for `peer_host`.

Rule: the learner finds out what was wrong with a client. libzmq tells a worker only whether its key was refused, which is
the one problem that a retry cannot solve. Every other problem looks to the worker like a closed connection, so the worker
logs the likely causes, and tries again.
"""

from __future__ import annotations

import errno
import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import zmq

from millrace.protocol.keys.keys import Token, fingerprint

FAILED = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_AUTH
LEARNER_EVENTS = FAILED | zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED
WORKER_EVENTS = FAILED | zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED
HANDSHAKE_MS = 2000
NOT_ALLOWED = 400  # ZAP's status code for a key that is not allowed


# ---------------------------------------------------------------- the worker's side


@dataclass(frozen=True)
class ConnectionProblem:
    """Why a worker is not connected."""

    line: str
    final: bool = False
    """whether a retry is useless, because the learner has refused this key"""


def connection_problem(event: int, value: int, address: str, token: Token | None) -> ConnectionProblem:
    """The likely cause of a failed handshake, as the worker logs it. `event` and `value` come from libzmq's monitor."""
    if event == zmq.EVENT_HANDSHAKE_FAILED_AUTH and value == NOT_ALLOWED:
        key = fingerprint(token.client.public) if token else "none"
        advice = (
            "on the learner's machine: `millrace keys show` lists those that may, `millrace keys new NAME` makes another"
        )
        return ConnectionProblem(
            f"the learner at {address} refused this worker's key {key}: not allowed there, or revoked; {advice}", True
        )
    if event == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL and value in (errno.EAGAIN, errno.ETIMEDOUT):
        return ConnectionProblem(
            f"{address} answers, but did not finish the handshake within {HANDSHAKE_MS // 1000} s; is it a millrace learner?"
        )
    if token is None:
        why = "perhaps it asks for a key: give this worker --token FILE (`millrace keys new NAME` on its machine makes one)"
    else:
        why = "perhaps this token is of another learner, or the learner was started without keys; then leave the token out"
    return ConnectionProblem(f"{address} breaks off the handshake; {why}")


# ---------------------------------------------------------------- the learner's side


def handshake_failure(event: int, value: int, keys: bool) -> str:
    """Why a client's handshake failed, as the learner logs it. `keys` says whether the learner has keys."""
    match event, value:
        case zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC:
            return "its token is for another learner: it expects another server key"
        case zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH if keys:
            return "it shows no key; a worker needs --token"
        case zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH:
            return "it shows a key, and this learner has none: leave its token out, or start the learner with --keys"
        case zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, _:
            return f"it violates the protocol of the handshake ({value:#x})"
        case _, errno.EAGAIN | errno.ETIMEDOUT:
            return f"it did not finish the handshake within {HANDSHAKE_MS // 1000} s"
        case _, errno.EPIPE | errno.ECONNRESET:
            perhaps = "it has no token" if keys else "it has a token, and this learner no keys"
            return f"it broke off the handshake; perhaps {perhaps}"
        case _:
            return f"its handshake failed ({errno.errorcode.get(value, value)})"


NO_ZEROMQ = "it does not speak ZeroMQ, or left before it had said who it is"


class PendingHandshakes:
    """Connections whose handshake is not finished. Finds out which client's handshake failed, for the log only.

    libzmq reports a connection's descriptor when the connection is accepted and when it ends, but not in between. The first
    connection that ends after a failure is the one that failed. Which handshake succeeded is guessed from the addresses that
    ZAP approved.
    """

    def __init__(self, keys: bool, host_of: Callable[[int], str] | None = None) -> None:
        self._keys = keys
        self._host_of = host_of or peer_host
        self._pending: dict[int, str] = {}
        self._failed: tuple[int, int] | None = None
        self._approved: deque[str] = deque(maxlen=100)

    def add_approved(self, host: str) -> None:
        """Record that ZAP approved a client at this address, so that its handshake will succeed."""
        self._approved.append(host)

    def handle_event(self, event: int, value: int) -> tuple[str, str] | None:
        """Handle an event of the monitor. Returns the host and the reason of a failed handshake once they are known.

        For a refused key it always returns None, because the ZAP handler reports that.
        """
        match event:
            case zmq.EVENT_ACCEPTED:
                self._pending[value] = self._host_of(value)
            case zmq.EVENT_HANDSHAKE_SUCCEEDED:
                host = self._approved.popleft() if self._approved else None
                if self._pending:
                    del self._pending[
                        next((one for one, at in self._pending.items() if at == host), next(iter(self._pending)))
                    ]
            case zmq.EVENT_DISCONNECTED:
                host = self._pending.pop(value, None)
                failed = self._failed
                self._failed = None
                if failed is not None and failed[0] != zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                    return host or "", handshake_failure(*failed, self._keys)
                if failed is None and host is not None:
                    return host, NO_ZEROMQ
            case _:
                self._failed = event, value
        return None


def peer_host(descriptor: int) -> str:
    """The address of a connection's peer; empty if the connection has ended. Leaves the descriptor open: it is libzmq's."""
    try:
        borrowed = socket.socket(fileno=descriptor)
    except OSError:
        return ""
    try:
        name = borrowed.getpeername()
        return str(name[0]) if isinstance(name, tuple) else ""
    except OSError:
        return ""
    finally:
        borrowed.detach()
