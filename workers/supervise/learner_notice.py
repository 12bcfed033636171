"""Reports to the learner, over the supervisor's own connection, what running workers are doing, and how others ended.

Rule: a report is sent about every second, and more often while a call to an environment is taking long. It names an ended
worker for a while, because a message may be lost. A worker that failed is named immediately; a worker that left on purpose
is named a moment later, so that its own last messages arrive first. Nothing is sent before a worker has joined, because the
worker itself reports a wrong address or key. This file imports neither numpy nor gymnasium.

If the workers share weights, the learner sends each version once, over this connection. It answers each report, so that both
sides know what has arrived. Its answer also says to which learner the weights belong, as a Welcome does on a worker's
connection.
"""

from __future__ import annotations

import logging
import os
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress

import msgspec
import zmq

from millrace.protocol.alive import Alive, WorkerActivity, WorkerExit
from millrace.protocol.bounds import INVALID, MAX_NAME, MAX_WORKERS
from millrace.protocol.keys.handshake import connect_with
from millrace.protocol.keys.keys import Token
from millrace.protocol.wire.socket_options import RECONNECT_MOST_MS, RECONNECT_MS, routing_id, set_options
from millrace.workers.shared_weights import SharedWeights

log = logging.getLogger("millrace.worker")

EVERY_S = 1.0  # interval between two reports
EVERY_S_WHILE_SLOW = 0.4  # the interval while a call to an environment takes longer than `SLOW_S`
SLOW_S = 0.3  # during a longer call, the worker can't send heartbeats, and the learner relies on these reports
ENDED_AFTER_S = 0.2  # a worker that left on purpose is named this long after its end
ENDED_FOR_S = 5.0  # for how long after its end a worker is named


class AliveSender:
    """The supervisor's connection to the learner."""

    def __init__(self, address: str, token: Token | None, weights: SharedWeights | None = None) -> None:
        """The connection is made when `send` has something to report for the first time.

        If the workers share weights, `weights` distributes those that arrive.
        """
        self._address = address
        self._token = token
        self._weights = weights
        self._first_session = self._replies = 0  # as in the learner's last answer
        self._socket: zmq.Socket[bytes] | None = None
        self._due_s = 0.0
        self._ended: list[tuple[float, WorkerExit]] = []
        self._reported: set[int] = set()  # nonces of the ended workers that the last report named
        self._encoder = msgspec.msgpack.Encoder()

    def send(self, running: Sequence[WorkerActivity], ended: Sequence[WorkerExit], now: float) -> None:
        """Report the running workers, and those that have ended since the last call, if a report is due at `now`."""
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
            replies = None if self._weights is None else self._replies
            self._say(Alive(tuple(joined[first : first + MAX_WORKERS]), reported[:MAX_WORKERS], replies))

    def listen(self, for_s: float) -> bool:
        """Handle the learner's messages for this many seconds. Returns whether it has said that the run is over."""
        if self._socket is None:
            time.sleep(for_s)
            return False
        until_s = time.monotonic() + for_s
        over = False
        while self._socket.poll(max(0, int(1000 * (until_s - time.monotonic())))):
            over |= self._take(self._socket.recv_multipart(copy=False))
            if time.monotonic() >= until_s:
                break
        return over

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close(linger=200)

    def _take(self, frames: Sequence[zmq.Frame]) -> bool:
        """Handle a message from the learner; ignore an unreadable one. Returns whether it says that the run is over."""
        with suppress(*INVALID):
            match msgspec.msgpack.decode(frames[0].bytes):
                case ["Drain", *_]:
                    return True
                case ["HeartbeatReply", int(first_session), int(number), _]:
                    self._first_session = first_session
                    self._replies = number
                case ["Weights", int(version), *_] if self._weights is not None:
                    self._share(version, [frame.buffer for frame in frames])
        return False

    def _share(self, version: int, frames: Sequence[memoryview]) -> None:
        assert self._weights is not None
        try:
            self._weights.write(self._first_session, version, frames)
        except (OSError, struct.error) as error:
            log.warning("the workers cannot share weights; from now on each receives its own: %s", error)
            self._weights = None

    def _say(self, message: Alive) -> None:
        if self._socket is None:
            self._socket = self._connected()
        with suppress(zmq.Again):
            self._socket.send(self._encoder.encode(message), zmq.NOBLOCK)

    def _connected(self) -> zmq.Socket[bytes]:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        dealer = context.socket(zmq.DEALER)
        set_options(dealer, self._address, self._token is not None)
        dealer.sndhwm = 10  # a short queue, because only the newest report matters
        name = f"supervisor-{socket.gethostname()}-{os.getpid()}-{os.urandom(3).hex()}"[-MAX_NAME:]
        dealer.routing_id = routing_id(name, self._token)
        dealer.reconnect_ivl = RECONNECT_MS
        dealer.reconnect_ivl_max = RECONNECT_MOST_MS
        if self._token is not None:
            connect_with(dealer, self._token)
        dealer.connect(self._address)
        return dealer
