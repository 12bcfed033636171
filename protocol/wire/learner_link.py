"""The learner's end of the connections: one ROUTER socket for many workers. The address determines the transport.

The socket needs two options. Without ROUTER_MANDATORY, a ROUTER silently drops messages at its high-water mark. Without
ROUTER_HANDOVER, a worker that returns is locked out until its half-open connection times out. Only one thread may use a
link.

With keys, a peer is identified by its routing id *and* its key, which libzmq verifies for every message. A client that
claims another's routing id with its own key is therefore a different peer, which can neither speak in that worker's session
nor end it. Nor can it cause a handover, which would leave the worker's connection open but unread, because the worker's
routing id ends in a tag that only the holder of the worker's key can compute.
"""

from __future__ import annotations

import errno
import logging
import time
from collections.abc import Iterator, Sequence

import zmq

from millrace.protocol.address import check_address, name_for_people
from millrace.protocol.errors import BadMessage, RunError, UsageError
from millrace.protocol.keys.handshake import AuthenticatorThread
from millrace.protocol.keys.key_folder import Keyring
from millrace.protocol.logs.log_rate_limiter import LogRateLimiter, suppressed_note
from millrace.protocol.messages import Inquire, Refuse, ToLearner
from millrace.protocol.wire.codec import Buffer, decode_to_learner, encode
from millrace.protocol.wire.socket_options import LINGER_MS, set_options
from millrace.protocol.wire.sockets import Traffic, receive_frames, send_frames

log = logging.getLogger("millrace.link")

MAX_MESSAGES = 10_000
MAX_REMEMBERED_KEYS = 10_000


class RefusedMessage(BadMessage):
    """A message whose key is no longer allowed. The link has answered it."""


class LearnerLink:
    """The learner's end: one port, many workers."""

    def __init__(
        self, address: str, context: zmq.Context[zmq.Socket[bytes]] | None = None, keyring: Keyring | None = None
    ) -> None:
        """Bind to the address. With a keyring (only over tcp), only the clients on its list may connect.

        A context can have only one link with a keyring. Raises `UsageError` if the address is not valid or can't be bound.
        """
        check_address(address)
        self.context = context or zmq.Context.instance()
        self.keyring = keyring
        self.received = Traffic()
        self.sent = Traffic()
        self.refused_messages = 0
        """number of messages that were refused because their keys are no longer allowed"""
        self.packed_bytes_limit = 0
        """largest total unpacked size, in bytes, of the packed arrays of one message; 0: no array may be packed"""
        self._last_keys: dict[bytes, str] = {}  # routing id -> key of its last message
        self._log_limiter = LogRateLimiter()
        self._socket = self.context.socket(zmq.ROUTER)
        set_options(self._socket, address, keyring is not None)
        self._socket.router_mandatory = True
        self._socket.router_handover = True
        self._authenticator: AuthenticatorThread | None = None
        try:
            if address.startswith("tcp://"):
                self._authenticator = AuthenticatorThread(self._socket, keyring)  # must exist before the port is bound
            self._socket.bind(address)
        except UsageError:
            self.close(linger_s=0.0)
            raise
        except zmq.ZMQError as error:
            self.close(linger_s=0.0)
            raise UsageError(_bind_error(address, error)) from error
        self.address = bytes(self._socket.get(zmq.LAST_ENDPOINT)).decode().rstrip("\0")
        """the address to which workers connect, with the port that was chosen for `*`"""

    @property
    def refused(self) -> int:
        """Number of failed handshakes."""
        return self._authenticator.refused if self._authenticator is not None else 0

    def poll(self, timeout_s: float) -> bool:
        """Wait until a message arrives, for at most `timeout_s` seconds. Returns whether one has arrived.

        Raises `RunError` if the authenticator's thread has ended.
        """
        if self._authenticator is not None and not self._authenticator.is_alive():
            raise RunError(f"authenticator of {self.address}: its thread has ended, see the log; start again with --resume")
        return bool(self._socket.poll(max(0, int(timeout_s * 1000))))

    def poll_beside(self, fds: Sequence[int], timeout_s: float) -> bool:
        """Wait until a message arrives, or one of these file descriptors can be read, for at most `timeout_s` seconds.

        Returns whether a message has arrived.
        """
        poller = zmq.Poller()
        for each in (self._socket, *fds):
            poller.register(each, zmq.POLLIN)
        return any(ready is self._socket for ready, _ in poller.poll(max(0, int(timeout_s * 1000))))

    def receive(self) -> Iterator[tuple[bytes, ToLearner | Inquire | BadMessage]]:
        """Messages that have arrived, each with its sender; at most MAX_MESSAGES. In place of an unreadable or a refused
        message, yields the error, so that the caller can stop when it has listened for long enough.
        """
        sender_keys: list[str] | None = None if self.keyring is None else []
        for _ in range(MAX_MESSAGES):  # so that a flood can't block the learner
            frames = receive_frames(self._socket, sender_keys)
            if frames is None:
                return
            self.received.add(frames)
            peer = bytes(frames[0])
            if sender_keys is not None:
                peer = self._peer(peer, sender_keys[0])
                if why := self._refuse_key(peer):
                    yield peer, RefusedMessage(why)
                    continue
            try:
                yield peer, decode_to_learner(frames[1:], self.packed_bytes_limit)
            except BadMessage as error:
                yield peer, error

    def rejection_reason(self, peer: bytes) -> str:
        """Why this peer is no longer allowed to connect, or an empty string if it still is."""
        return "" if self.keyring is None else self.keyring.allowed.rejection_reason(_key_of(peer))

    def name_for_log(self, peer: bytes) -> str:
        """The name for log lines about this peer: the name of its key, or, without keys, the name that it gives itself."""
        return name_for_people(peer) if self.keyring is None else self.keyring.allowed.name_of(_key_of(peer))

    def source(self, peer: bytes) -> str:
        """The name of this peer's key. Empty without keys, because then names prove nothing."""
        return "" if self.keyring is None else self.name_for_log(peer)

    def _peer(self, routing_id: bytes, key: str) -> bytes:
        """The id of the peer with this routing id and key. Records that this key was the last one to use the routing id."""
        self._last_keys.pop(routing_id, None)  # so that the dict stays ordered by last message
        self._last_keys[routing_id] = key
        if len(self._last_keys) > MAX_REMEMBERED_KEYS:
            del self._last_keys[next(iter(self._last_keys))]
        return b"%s\0%s" % (routing_id, key.encode())

    def _refuse_key(self, peer: bytes) -> str:
        """If the peer's key is no longer allowed, count its message and answer with a `Refuse`. Returns why, or ''."""
        why = self.rejection_reason(peer)
        if why:
            self.refused_messages += 1
            self.send(peer, encode(Refuse(why)))
            if (kept_back := self._log_limiter.due(why, time.monotonic())) is not None:
                log.warning(
                    "worker %s is not heard: %s%s",
                    name_for_people(peer),
                    why,
                    suppressed_note(kept_back),
                )
        return why

    def send(self, peer: bytes, frames: Sequence[Buffer]) -> bool:
        """Send a message. Returns False if the peer is gone or its queue is full."""
        if self.keyring is not None:
            routing_id, _, key = peer.rpartition(b"\0")
            if self._last_keys.get(routing_id) != key.decode():
                return False  # another peer uses the routing id now
            peer = routing_id
        whole = [peer, *frames]
        try:
            send_frames(self._socket, whole)
        except zmq.ZMQError as error:
            if error.errno in (zmq.EHOSTUNREACH, zmq.EAGAIN):
                return False
            raise
        self.sent.add(whole)
        return True

    def close(self, linger_s: float = LINGER_MS / 1000) -> None:
        """Send queued messages, for at most `linger_s` seconds, and close the socket."""
        if self._authenticator is not None and not self._socket.closed:
            self._socket.disable_monitor()  # before the monitor's reader is closed: libzmq blocks without a reader
        self._socket.close(linger=int(linger_s * 1000))
        if self._authenticator is not None:
            self._authenticator.close()


def _key_of(peer: bytes) -> bytes:
    """The public key of a peer; empty if there is none."""
    try:
        return bytes.fromhex(peer.rpartition(b"\0")[2].decode())
    except ValueError:
        return b""


def _bind_error(address: str, error: zmq.ZMQError) -> str:
    match error.errno:
        case zmq.EADDRINUSE:
            return f"address {address} is in use; choose another port, or tcp://127.0.0.1:* for any free one"
        case errno.ENAMETOOLONG:
            return f"address {address}: expected a path of at most {zmq.IPC_PATH_MAX_LEN} bytes"
        case _:
            return (
                f"address {address}: cannot bind ({error.strerror}); expected one of this machine, as tcp://127.0.0.1:5555"
            )
