"""What libzmq's monitor says of a handshake, in words for the people on both sides. Pure, but for one look at a connection.

The law: the learner can tell what a visitor lacked; a worker is told by libzmq only whether its key was refused, and that is
the one thing that no retry can heal. All else it sees as a connection that is broken off, so it is told what may be meant,
and goes on trying.
"""

from __future__ import annotations

import errno
import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import zmq

from protocol.keys.keys import Token, fingerprint

FAILED = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_AUTH
WATCHED = FAILED | zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED
WATCHED_BY_WORKER = FAILED | zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED
HANDSHAKE_MS = 2000
NOT_ALLOWED = 400  # ZAP's word for: this key, no


# ---------------------------------------------------------------- the worker's side


@dataclass(frozen=True)
class ConnectionProblem:
    """Why a worker is not connected."""

    line: str
    final: bool = False
    """no retry can heal it: the learner has refused this key"""


def connection_problem(event: int, value: int, address: str, token: Token | None) -> ConnectionProblem:
    """What a failed handshake means to a worker."""
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
    """What was wrong with a visitor's handshake, to a learner with or without keys."""
    match event, value:
        case zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC:
            return "it believes in the key of another learner: its token is not of this one"
        case zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH if keys:
            return "it shows no key; a worker needs --token"
        case zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH:
            return "it shows a key, and this learner has none: leave its token out, or start the learner with --keys"
        case zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, _:
            return f"it breaks the protocol of the handshake ({value:#x})"
        case _, errno.EAGAIN | errno.ETIMEDOUT:
            return f"it did not finish the handshake within {HANDSHAKE_MS // 1000} s"
        case _, errno.EPIPE | errno.ECONNRESET:
            perhaps = "it has no token" if keys else "it has a token, and this learner no keys"
            return f"it broke off the handshake; perhaps {perhaps}"
        case _:
            return f"its handshake failed ({errno.errorcode.get(value, value)})"


NO_ZEROMQ = "it does not speak ZeroMQ, or left before it had said who it is"


class PendingHandshakes:
    """Connections whose handshake is not over. Finds out whose handshake it was that failed.

    libzmq names a connection by its descriptor when it is accepted and when it ends, and not in between. A failure is
    followed by the end of the same connection; which one succeeded is guessed from the addresses that ZAP let in. It serves
    the log alone.
    """

    def __init__(self, keys: bool, host_of: Callable[[int], str] | None = None) -> None:
        self._keys, self._host_of = keys, host_of or peer_host
        self._fresh: dict[int, str] = {}
        self._failed: tuple[int, int] | None = None
        self._approved: deque[str] = deque(maxlen=100)

    def approved(self, host: str) -> None:
        """ZAP let somebody in from there: its handshake will succeed."""
        self._approved.append(host)

    def saw(self, event: int, value: int) -> tuple[str, str] | None:
        """An event of the monitor. Whose handshake failed, and why, once that is known; a refused key is ZAP's to tell."""
        match event:
            case zmq.EVENT_ACCEPTED:
                self._fresh[value] = self._host_of(value)
            case zmq.EVENT_HANDSHAKE_SUCCEEDED:
                host = self._approved.popleft() if self._approved else None
                if self._fresh:
                    del self._fresh[next((one for one, at in self._fresh.items() if at == host), next(iter(self._fresh)))]
            case zmq.EVENT_DISCONNECTED:
                host, failed = self._fresh.pop(value, None), self._failed
                self._failed = None
                if failed is not None and failed[0] != zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                    return host or "", handshake_failure(*failed, self._keys)
                if failed is None and host is not None:
                    return host, NO_ZEROMQ
            case _:
                self._failed = event, value
        return None


def peer_host(descriptor: int) -> str:
    """The address at the other end; empty if the connection has ended already. The descriptor is libzmq's, and stays so."""
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
