"""Tells the learner, on a connection of the supervisor's own, which workers are alive, what they do, and how others ended.

Rule: it says so about every second, and more often while a call of an environment takes long. An ended worker is named for a
while, because a message may be lost: a failed one at once, one that left on purpose a moment later, so that its own last
messages come first. Nothing is sent before a worker has joined: a wrong address or key is the worker's to report. This file
imports neither numpy nor gymnasium.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from contextlib import suppress

import msgspec
import zmq

from protocol.alive import Alive, WorkerActivity, WorkerExit
from protocol.bounds import MAX_NAME, MAX_WORKERS
from protocol.keys.keys import Token
from protocol.keys.zap import connect_with
from protocol.wire.socket_options import RECONNECT_MOST_MS, RECONNECT_MS, routing_id, set_options

EVERY_S = 1.0
EVERY_S_WHILE_SLOW = 0.4
SLOW_S = 0.3  # a call of an environment that takes longer: its worker does not send heartbeats meanwhile
ENDED_AFTER_S, ENDED_FOR_S = 0.2, 5.0


class AliveSender:
    """The supervisor's connection to the learner."""

    def __init__(self, address: str, token: Token | None) -> None:
        """Connects at the first `send` that has something to say."""
        self._address, self._token = address, token
        self._socket: zmq.Socket[bytes] | None = None
        self._due_s = 0.0
        self._ended: list[tuple[float, WorkerExit]] = []
        self._reported: set[int] = set()  # nonces of the ended workers that the last message named
        self._encoder = msgspec.msgpack.Encoder()

    def send(self, running: Sequence[WorkerActivity], ended: Sequence[WorkerExit], now: float) -> None:
        """Say this, if it is time to."""
        self._ended += [(now, each) for each in ended]
        self._ended = [(at, each) for at, each in self._ended if now - at < ENDED_FOR_S]
        joined = [each for each in running if each.doing != "starting"]
        slow = any(each.for_s > SLOW_S and each.doing != "waiting" for each in joined)
        if slow:
            self._due_s = min(self._due_s, now + EVERY_S_WHILE_SLOW)
        reported = tuple(each for at, each in self._ended if each.failed or now - at >= ENDED_AFTER_S)
        news = not self._reported.issuperset(each.process_nonce for each in reported)
        if (now < self._due_s and not news) or not (joined or reported):
            return
        self._reported = {each.process_nonce for each in reported}
        self._due_s = now + (EVERY_S_WHILE_SLOW if slow else EVERY_S)
        for first in range(0, max(len(joined), 1), MAX_WORKERS):
            self._say(Alive(tuple(joined[first : first + MAX_WORKERS]), reported[:MAX_WORKERS]))

    def run_is_over(self) -> bool:
        """Whether the learner has answered, since the last call, that the run is over."""
        over = False
        if self._socket is not None:
            with suppress(zmq.Again):
                while not over:
                    over = _is_drain(self._socket.recv_multipart(zmq.NOBLOCK)[0])
        return over

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close(linger=200)

    def _say(self, message: Alive) -> None:
        if self._socket is None:
            self._socket = self._connected()
        with suppress(zmq.Again):
            self._socket.send(self._encoder.encode(message), zmq.NOBLOCK)

    def _connected(self) -> zmq.Socket[bytes]:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        found = context.socket(zmq.DEALER)
        set_options(found, self._address, self._token is not None)
        found.sndhwm = 10  # only the newest word counts
        name = f"supervisor-{socket.gethostname()}-{os.getpid()}-{os.urandom(3).hex()}"[-MAX_NAME:]
        found.routing_id = routing_id(name, self._token)
        found.reconnect_ivl, found.reconnect_ivl_max = RECONNECT_MS, RECONNECT_MOST_MS
        if self._token is not None:
            connect_with(found, self._token)
        found.connect(self._address)
        return found


def _is_drain(head: bytes) -> bool:
    """Whether this is the head of a `Drain`. Everything else is of no interest here."""
    with suppress(msgspec.MsgspecError):
        match msgspec.msgpack.decode(head):
            case ["Drain", *_]:
                return True
    return False
