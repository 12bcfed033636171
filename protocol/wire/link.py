"""Sockets, and nothing else: the learner's ROUTER and the worker's DEALER. The address chooses the transport.

Every option here was learned by an experiment. ROUTER_MANDATORY: a plain ROUTER drops silently at its high-water mark.
ROUTER_HANDOVER: else a returning worker is locked out until its half-open connection times out. No ZMTP heartbeats: with a
reader stopped by its high-water mark they lose and reorder messages; our own heartbeats judge silence, and tickets are the
credit that keeps queues short. MAXMSGSIZE bounds a frame before a byte of it is read. TCP_MAXRT and keepalive: a connection
whose other end has vanished is closed, and made anew by the worker, in seconds. A link belongs to one thread.

With keys, a peer is a routing id *and* the key under which it speaks, which libzmq vouches for on every message. So whoever
claims another's routing id under a key of its own is another peer: it cannot speak in that worker's session, nor end it. It
cannot even cut its connection (a handover leaves the earlier one open and deaf), because a worker's routing id then ends in
a tag that only the holder of its key can make.
"""

from __future__ import annotations

import hashlib
import logging
import os
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

import zmq

from protocol.address import check_address, is_local, name_of, needs_ipv6, resolves
from protocol.errors import BadMessage, RunError, UsageError
from protocol.keys.handshake import HANDSHAKE_MS, WATCHED_BY_WORKER, Trouble, trouble
from protocol.keys.key_folder import Keyring
from protocol.keys.keys import Token
from protocol.keys.zap import Door, connect_with
from protocol.log_limit import Rarely, again
from protocol.messages import Inquire, Refuse, ToLearner, ToObserver, ToWorker
from protocol.wire.codec import (
    MAX_FRAME_BYTES,
    MAX_FRAMES,
    Buffer,
    decode_to_learner,
    decode_to_observer,
    decode_to_worker,
    encode,
)
from protocol.wire.compression import Packing

Said = TypeVar("Said")

log = logging.getLogger("millrace.link")

LINGER_MS = 2000
UNACKNOWLEDGED_MS = 5000  # TCP waits ever longer between two tries: after a cut, as long again as the cut was
QUEUE = 1000  # messages: for a peer that talks and does not read
MESSAGES_AT_ONCE = 10_000
COPY_BELOW_BYTES = 65536  # smaller frames are copied: cheaper than keeping track of them
CURVE_BYTES = 33  # what encryption adds to a frame
HOLDERS = 10_000  # routing ids whose last speaker is remembered
TAG_CHARACTERS = 32
NOT_WAITING, AND_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)


def _options(socket: zmq.Socket[bytes], address: str, curve: bool) -> None:
    socket.linger = LINGER_MS
    socket.maxmsgsize = MAX_FRAME_BYTES + (CURVE_BYTES if curve else 0)
    socket.handshake_ivl = HANDSHAKE_MS
    socket.connect_timeout = 2000
    socket.tcp_maxrt = UNACKNOWLEDGED_MS
    # A host that vanished while nothing was on its way: nobody would notice, and its connection would stay for ever.
    socket.tcp_keepalive, socket.tcp_keepalive_idle, socket.tcp_keepalive_intvl, socket.tcp_keepalive_cnt = 1, 15, 5, 3
    socket.ipv6 = needs_ipv6(address)
    # Credit bounds what is under way (one Weights, a few tickets and their rollouts) far below these.
    socket.sndhwm = socket.rcvhwm = QUEUE


def _receive(socket: zmq.Socket[bytes], said_by: list[str] | None = None) -> list[Buffer] | None:
    """The next message's frames, or None. Of one with too many it keeps enough to show that, and throws the rest away.

    `said_by`, if given, is filled with the key of each frame's sender, as libzmq proved it in the handshake.
    """
    frames: list[Buffer] = []
    try:
        more = True
        while more:
            frame = socket.recv(NOT_WAITING, copy=False)
            if said_by is not None and not frames:
                said_by[:] = [_user(frame)]
            more = frame.more
            if len(frames) < MAX_FRAMES + 2:  # the sender's name, and one too many
                frames.append(frame.buffer if len(frame) >= COPY_BELOW_BYTES else frame.bytes)
    except zmq.Again:
        return None
    return frames


def _send(socket: zmq.Socket[bytes], frames: Sequence[Buffer]) -> None:
    """What `send_multipart` does, which reckons flags and checks types anew for each frame: half of what sending costs."""
    for frame in frames[:-1]:
        socket.send(frame, AND_MORE, copy=False)
    socket.send(frames[-1], NOT_WAITING, copy=False)


def _user(frame: zmq.Frame) -> str:
    try:
        return str(frame.get("User-Id"))
    except zmq.ZMQError:  # there is none, which must not happen: nobody has such a key
        return ""


@dataclass
class Traffic:
    """What went one way. The bytes are those of the frames, before encryption; the worker's name is one of them."""

    messages: int = 0
    bytes: int = 0

    def add(self, frames: Sequence[Buffer]) -> None:
        """One message more."""
        self.messages += 1
        self.bytes += sum(map(len, frames))


class LearnerLink:
    """The learner's end: many workers, one port."""

    def __init__(
        self, address: str, context: zmq.Context[zmq.Socket[bytes]] | None = None, keyring: Keyring | None = None
    ) -> None:
        """With a keyring (tcp alone) only those on it get in. There can be one such link in a context."""
        check_address(address)
        self.context = context or zmq.Context.instance()
        self.keyring = keyring
        self.received, self.sent = Traffic(), Traffic()
        self.refused_messages = 0
        """messages under keys that may speak no more"""
        self.room = 0
        """bytes to which the packed arrays of one message may come; 0: none may come packed"""
        self._holders: dict[bytes, str] = {}  # routing id -> key under which it spoke last
        self._lid = Rarely()
        self._socket = self.context.socket(zmq.ROUTER)
        _options(self._socket, address, keyring is not None)
        self._socket.router_mandatory = True
        self._socket.router_handover = True
        self._door: Door | None = None
        try:
            if address.startswith("tcp://"):
                self._door = Door(self._socket, keyring)  # before the port is bound
            self._socket.bind(address)
        except UsageError:
            self.close(linger_s=0.0)
            raise
        except zmq.ZMQError as error:
            self.close(linger_s=0.0)
            raise UsageError(_why_not_bound(address, error)) from error
        self.address = bytes(self._socket.get(zmq.LAST_ENDPOINT)).decode().rstrip("\0")
        """where workers connect: the port that was chosen, if it was `*`"""

    @property
    def refused(self) -> int:
        """Handshakes that failed, of those who were not let in."""
        return self._door.refused if self._door is not None else 0

    def poll(self, timeout_s: float) -> bool:
        """Wait until something arrives, at most `timeout_s`. Raises `RunError` if nobody stands at the door."""
        if self._door is not None and not self._door.is_alive():
            raise RunError(
                f"the door of {self.address} is shut: its thread has ended, see the log; start again with --resume"
            )
        return bool(self._socket.poll(max(0, int(timeout_s * 1000))))

    def receive(self) -> Iterator[tuple[bytes, ToLearner | Inquire | BadMessage]]:
        """What has arrived, with its sender; what cannot be read comes as its error. At most MESSAGES_AT_ONCE."""
        said_by: list[str] | None = None if self.keyring is None else []
        for _ in range(MESSAGES_AT_ONCE):  # a flood must not keep the learner here
            frames = _receive(self._socket, said_by)
            if frames is None:
                return
            self.received.add(frames)
            peer = bytes(frames[0])
            if said_by is not None:
                peer = self._held(peer, said_by[0])
                if self._turned_away(peer):
                    continue
            try:
                yield peer, decode_to_learner(frames[1:], self.room)
            except BadMessage as error:
                yield peer, error

    def why_not(self, peer: bytes) -> str:
        """Why this peer may speak no more; empty if it may."""
        return "" if self.keyring is None else self.keyring.allowed.why_not(_key_of(peer))

    def speaker(self, peer: bytes) -> str:
        """Who answers for what this peer sends: the name of its key, or else its own."""
        return (
            name_of(peer).decode(errors="replace") if self.keyring is None else self.keyring.allowed.name_of(_key_of(peer))
        )

    def _held(self, routing_id: bytes, key: str) -> bytes:
        """The peer that speaks from this routing id now."""
        self._holders.pop(routing_id, None)  # the one that spoke longest ago stands first
        self._holders[routing_id] = key
        if len(self._holders) > HOLDERS:
            del self._holders[next(iter(self._holders))]
        return b"%s\0%s" % (routing_id, key.encode())

    def _turned_away(self, peer: bytes) -> bool:
        """A message under a key that may speak no more is counted, answered and not read."""
        why = self.why_not(peer)
        if why:
            self.refused_messages += 1
            self.send(peer, encode(Refuse(why)))
            if (kept_back := self._lid.due(why, time.monotonic())) is not None:
                log.warning("worker %s is not heard: %s%s", name_of(peer).decode(errors="replace"), why, again(kept_back))
        return bool(why)

    def send(self, peer: bytes, frames: Sequence[Buffer]) -> bool:
        """Send; False if the peer is gone."""
        if self.keyring is not None:
            routing_id, _, key = peer.rpartition(b"\0")
            if self._holders.get(routing_id) != key.decode():
                return False  # another one speaks from there now
            peer = routing_id
        whole = [peer, *frames]
        try:
            _send(self._socket, whole)
        except zmq.ZMQError as error:
            if error.errno in (zmq.EHOSTUNREACH, zmq.EAGAIN):
                return False
            raise
        self.sent.add(whole)
        return True

    def close(self, linger_s: float = LINGER_MS / 1000) -> None:
        """Send what is queued, at most `linger_s`, and close."""
        if self._door is not None and not self._socket.closed:
            self._socket.disable_monitor()  # before its reader goes: libzmq would wait for one
        self._socket.close(linger=int(linger_s * 1000))
        if self._door is not None:
            self._door.close()


class WorkerLink:
    """A worker's end."""

    def __init__(
        self,
        address: str,
        name: str,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
        token: Token | None = None,
    ) -> None:
        """With a token (tcp alone) it speaks with that token's learner and nobody else."""
        check_address(address)
        longest = 255 - (TAG_CHARACTERS + 1)
        if not 1 <= len(name.encode()) <= longest or "\0" in name:
            raise UsageError(f"worker name {name[:40]!r}: expected 1 to {longest} bytes, got {len(name.encode())}")
        self.address, self.token = address, token
        self.trouble: Trouble | None = None
        """why there is no connection, as far as that is known"""
        self.packing = Packing(stack=token is not None or not is_local(address))
        """of the rollouts that go over it: what is encrypted, or leaves this machine, is worth looking at first"""
        self._connected = False
        self._lid = Rarely()
        self.context = context or zmq.Context.instance()
        self._socket = self.context.socket(zmq.DEALER)
        _options(self._socket, address, token is not None)
        self._socket.routing_id = _routing_id(name, token)
        self._socket.reconnect_ivl = 100
        self._socket.reconnect_ivl_max = 2000
        self._monitor: zmq.Socket[bytes] | None = None
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        if address.startswith("tcp://"):
            self._watch()
        if token is not None:
            connect_with(self._socket, token)
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self.close(linger_s=0.0)
            raise UsageError(f"address {address}: cannot connect ({error.strerror})") from error
        if not resolves(address):
            self._say(Trouble(f"the host of {address} is not known here; is it spelt right?"))

    def poll(self, timeout_s: float) -> bool:
        """Wait until something arrives, at most `timeout_s`; also no longer than until the learner has refused our key."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            left_s = max(0.0, deadline_s - time.monotonic())
            ready = dict(self._poller.poll(int(left_s * 1000)))
            if self._monitor in ready:
                self._look()
            if self._socket in ready or left_s == 0.0 or (self.trouble is not None and self.trouble.final):
                return self._socket in ready

    def _watch(self) -> None:
        name = f"inproc://millrace-worker-{os.urandom(6).hex()}"
        self._socket.monitor(name, WATCHED_BY_WORKER)
        self._monitor = self.context.socket(zmq.PAIR)
        self._monitor.linger = 0
        self._monitor.rcvhwm = 0  # libzmq waits where nobody reads, and an environment's step may take minutes
        self._monitor.connect(name)
        self._poller.register(self._monitor, zmq.POLLIN)

    def _look(self) -> None:
        """What became of the connection."""
        assert self._monitor is not None
        with suppress(zmq.Again):
            while True:
                event, value = struct.unpack("=HI", self._monitor.recv_multipart(zmq.NOBLOCK)[0])
                if event == zmq.EVENT_DISCONNECTED:
                    if not self._connected and self.trouble is None:
                        self._say(Trouble(f"{self.address} closes the connection at once; is it a millrace learner?"))
                    self._connected = False
                elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                    self._connected, self.trouble = True, None
                else:
                    self._say(trouble(event, value, self.address, self.token))

    def _say(self, found: Trouble) -> None:
        self.trouble = found
        if not found.final and (kept_back := self._lid.due(found.line, time.monotonic())) is not None:
            log.warning("%s%s", found.line, again(kept_back))

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
            _send(self._socket, frames)

    def close(self, linger_s: float = LINGER_MS / 1000) -> None:
        """Send what is queued, at most `linger_s`, and close."""
        if self._monitor is not None and not self._socket.closed:
            self._socket.disable_monitor()  # before its reader goes: libzmq would wait for one
            self._monitor.close(linger=0)
        self._socket.close(linger=int(linger_s * 1000))


def _routing_id(name: str, token: Token | None) -> bytes:
    """The name; under a key with a tag behind it that nobody can make who has another key."""
    if token is None:
        return name.encode()
    tag = hashlib.blake2b(name.encode(), key=token.client.secret, digest_size=TAG_CHARACTERS // 2)
    return b"%s\0%s" % (name.encode(), tag.hexdigest().encode())


def _key_of(peer: bytes) -> bytes:
    """The public key under which a peer speaks; empty, which nobody has, if there is none."""
    try:
        return bytes.fromhex(peer.rpartition(b"\0")[2].decode())
    except ValueError:
        return b""


def _why_not_bound(address: str, error: zmq.ZMQError) -> str:
    match error.errno:
        case zmq.EADDRINUSE:
            return f"address {address} is in use; choose another port, or tcp://127.0.0.1:* for any free one"
        case _:
            return (
                f"address {address}: cannot bind ({error.strerror}); expected one of this machine, as tcp://127.0.0.1:5555"
            )
