"""Sockets, and nothing else: the learner's ROUTER and the worker's DEALER. The address chooses the transport.

Every option here was learned by an experiment. ROUTER_MANDATORY: a plain ROUTER drops silently at its high-water mark.
ROUTER_HANDOVER: else a returning worker is locked out until its half-open connection times out. No ZMTP heartbeats: with a
reader stopped by its high-water mark they lose and reorder messages; our own heartbeats judge silence, and tickets are the
credit that keeps queues short. MAXMSGSIZE bounds a frame before a byte of it is read. A link belongs to one thread.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TypeVar

import zmq

from protocol.codec import MAX_FRAME_BYTES, MAX_FRAMES, Buffer, decode_to_learner, decode_to_observer, decode_to_worker
from protocol.errors import BadMessage, UsageError
from protocol.messages import Inquire, ToLearner, ToObserver, ToWorker

Said = TypeVar("Said")

LINGER_MS = 2000
QUEUE = 1000  # messages: for a peer that talks and does not read
MESSAGES_AT_ONCE = 10_000
COPY_BELOW_BYTES = 65536  # smaller frames are copied: cheaper than keeping track of them


def check_address(address: str) -> str:
    """Return the address if it can be used. Raises `UsageError` in one line."""
    scheme, sep, rest = address.partition("://")
    if not sep or scheme not in {"inproc", "ipc", "tcp"} or not rest:
        raise UsageError(f"address {address}: expected inproc://NAME, ipc://PATH or tcp://HOST:PORT")
    if scheme == "tcp":
        port = rest.rpartition(":")[2]
        if port != "*" and not (port.isdecimal() and 0 < int(port) < 65536):
            raise UsageError(f"address {address}: expected a port, 1 to 65535, as in tcp://127.0.0.1:5555")
    return address


def is_local(address: str) -> bool:
    """True for addresses that only this machine can reach."""
    scheme, _, rest = address.partition("://")
    host = rest.rpartition(":")[0]
    if scheme in {"inproc", "ipc"} or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:  # a name; whatever it is resolved to, it is not ours to trust
        return False


def _options(socket: zmq.Socket[bytes]) -> None:
    socket.linger = LINGER_MS
    socket.maxmsgsize = MAX_FRAME_BYTES
    socket.handshake_ivl = 2000
    # Credit bounds what is under way (one Weights, a few tickets and their rollouts) far below these.
    socket.sndhwm = socket.rcvhwm = QUEUE


def _receive(socket: zmq.Socket[bytes]) -> list[Buffer] | None:
    """The next message's frames, or None. Of one with too many it keeps enough to show that, and throws the rest away."""
    frames: list[Buffer] = []
    try:
        more = True
        while more:
            frame = socket.recv(zmq.NOBLOCK, copy=False)
            more = frame.more
            if len(frames) < MAX_FRAMES + 2:  # the sender's name, and one too many
                frames.append(frame.buffer if len(frame) >= COPY_BELOW_BYTES else frame.bytes)
    except zmq.Again:
        return None
    return frames


class LearnerLink:
    """The learner's end: many workers, one port."""

    def __init__(self, address: str, context: zmq.Context[zmq.Socket[bytes]] | None = None) -> None:
        check_address(address)
        self.context = context or zmq.Context.instance()
        self._socket = self.context.socket(zmq.ROUTER)
        _options(self._socket)
        self._socket.router_mandatory = True
        self._socket.router_handover = True
        try:
            self._socket.bind(address)
        except zmq.ZMQError as error:
            self._socket.close(linger=0)
            raise UsageError(_why_not_bound(address, error)) from error
        self.address = bytes(self._socket.get(zmq.LAST_ENDPOINT)).decode().rstrip("\0")
        """where workers connect: the port that was chosen, if it was `*`"""

    def poll(self, timeout_s: float) -> bool:
        """Wait until something arrives, at most `timeout_s`."""
        return bool(self._socket.poll(max(0, int(timeout_s * 1000))))

    def receive(self) -> Iterator[tuple[bytes, ToLearner | Inquire | BadMessage]]:
        """What has arrived, with its sender; what cannot be read comes as its error. At most MESSAGES_AT_ONCE."""
        for _ in range(MESSAGES_AT_ONCE):  # a flood must not keep the learner here
            frames = _receive(self._socket)
            if frames is None:
                return
            peer = bytes(frames[0])
            try:
                yield peer, decode_to_learner(frames[1:])
            except BadMessage as error:
                yield peer, error

    def send(self, peer: bytes, frames: Sequence[Buffer]) -> bool:
        """Send; False if the peer is gone."""
        try:
            self._socket.send_multipart([peer, *frames], zmq.NOBLOCK, copy=False)
        except zmq.ZMQError as error:
            if error.errno in (zmq.EHOSTUNREACH, zmq.EAGAIN):
                return False
            raise
        return True

    def close(self, linger_s: float = LINGER_MS / 1000) -> None:
        """Send what is queued, at most `linger_s`, and close."""
        self._socket.close(linger=int(linger_s * 1000))


class WorkerLink:
    """A worker's end."""

    def __init__(self, address: str, name: str, context: zmq.Context[zmq.Socket[bytes]] | None = None) -> None:
        check_address(address)
        if not 1 <= len(name.encode()) <= 255:
            raise UsageError(f"worker name {name[:40]!r}: expected 1 to 255 bytes, got {len(name.encode())}")
        self.context = context or zmq.Context.instance()
        self._socket = self.context.socket(zmq.DEALER)
        _options(self._socket)
        self._socket.routing_id = name.encode()
        self._socket.reconnect_ivl = 100
        self._socket.reconnect_ivl_max = 2000
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self._socket.close(linger=0)
            raise UsageError(f"address {address}: cannot connect ({error.strerror})") from error

    def poll(self, timeout_s: float) -> bool:
        """Wait until something arrives, at most `timeout_s`."""
        return bool(self._socket.poll(max(0, int(timeout_s * 1000))))

    def receive(self) -> Iterator[ToWorker | BadMessage]:
        """All that has arrived; what cannot be read comes as its error."""
        return self._received(decode_to_worker)

    def answers(self) -> Iterator[ToObserver | BadMessage]:
        """All that has arrived for an observer, who is no worker: answers to Inquire."""
        return self._received(decode_to_observer)

    def _received(self, decode: Callable[[Sequence[Buffer]], Said]) -> Iterator[Said | BadMessage]:
        while (frames := _receive(self._socket)) is not None:
            try:
                yield decode(frames)
            except BadMessage as error:
                yield error

    def send(self, frames: Sequence[Buffer]) -> None:
        """Send, or queue while the learner is out of reach (the conversation repairs what is lost)."""
        with suppress(zmq.Again):
            self._socket.send_multipart(frames, zmq.NOBLOCK, copy=False)

    def close(self, linger_s: float = LINGER_MS / 1000) -> None:
        """Send what is queued, at most `linger_s`, and close."""
        self._socket.close(linger=int(linger_s * 1000))


def _why_not_bound(address: str, error: zmq.ZMQError) -> str:
    match error.errno:
        case zmq.EADDRINUSE:
            return f"address {address} is in use; choose another port, or tcp://127.0.0.1:* for any free one"
        case _:
            return (
                f"address {address}: cannot bind ({error.strerror}); expected one of this machine, as tcp://127.0.0.1:5555"
            )
