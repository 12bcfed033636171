"""A worker's end of its connection: one DEALER socket. The address sets the transport. Only one thread may use a link."""

from __future__ import annotations

import logging
import os
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TypeVar

import zmq

from millrace.protocol.address import check_address, check_worker_name, is_local, resolves
from millrace.protocol.errors import BadMessage, UsageError
from millrace.protocol.keys.handshake import connect_with
from millrace.protocol.keys.handshake_failures import WORKER_EVENTS, ConnectionProblem, connection_problem
from millrace.protocol.keys.keys import Token
from millrace.protocol.logs.log_rate_limiter import LogRateLimiter, suppressed_note
from millrace.protocol.messages import ToObserver, ToWorker
from millrace.protocol.wire.codec import Buffer, decode_to_observer, decode_to_worker
from millrace.protocol.wire.compression import Packing, has_zstd
from millrace.protocol.wire.message_sizes import MAX_HEAD_BYTES
from millrace.protocol.wire.socket_options import LINGER_MS, RECONNECT_MOST_MS, RECONNECT_MS, Limits, routing_id, set_options
from millrace.protocol.wire.sockets import receive_frames, send_frames

Decoded = TypeVar("Decoded")

OF_OBSERVER = Limits(frame_bytes=MAX_HEAD_BYTES, messages=8)
"""The limits of an observer. They are low, because the answers that it gets have no arrays, and the learner's address may
come from a stranger's run folder.
"""

log = logging.getLogger("millrace.link")


class WorkerLink:
    """The worker's end of its connection to the learner."""

    def __init__(
        self,
        address: str,
        name: str,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
        token: Token | None = None,
        limits: Limits | None = None,
    ) -> None:
        """Connect to the address. With a token (only over tcp), the link connects only to that token's learner.

        Over inproc, `context` must be the learner's context; closing the link doesn't close the context. If `limits` is
        None, they are those of a worker. Raises `UsageError` for an address or a name that is not valid.
        """
        check_address(address)
        check_worker_name(name)
        self.address = address
        self.token = token
        self.problem: ConnectionProblem | None = None
        """why there is no connection; None if that is not known"""
        self.connected = False
        """whether there seems to be a connection; always False for transports other than tcp"""
        far = token is not None or not is_local(address)
        self.packing = Packing(stack=far, zstd=far and has_zstd())
        """how rollouts may be packed: only if the connection is encrypted or leaves this machine"""
        self._log_limiter = LogRateLimiter()
        self._owns_context = context is None
        self.context: zmq.Context[zmq.Socket[bytes]] = context or zmq.Context()
        self._socket = self.context.socket(zmq.DEALER)
        set_options(self._socket, address, token is not None, limits)
        self._socket.routing_id = routing_id(name, token)
        self._socket.reconnect_ivl = RECONNECT_MS
        self._socket.reconnect_ivl_max = RECONNECT_MOST_MS
        self._monitor: zmq.Socket[bytes] | None = None
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._beside: int | None = None
        if address.startswith("tcp://"):
            self._open_monitor()
        if token is not None:
            connect_with(self._socket, token)
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self.close(linger_s=0.0)
            raise UsageError(f"address {address}: cannot connect ({error.strerror})") from error
        if not resolves(address):
            self._report(ConnectionProblem(f"the host of {address} is not known here; is it spelled right?"))

    def watch(self, fd: int) -> None:
        """From now on, let `poll` return early when this file descriptor can be read."""
        self._poller.register(fd, zmq.POLLIN)
        self._beside = fd

    def poll(self, timeout_s: float) -> bool:
        """Wait until a message arrives, for at most `timeout_s` seconds. Returns whether one has arrived.

        Returns early if the learner refuses our key, or the file descriptor given to `watch` can be read.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            left_s = max(0.0, deadline_s - time.monotonic())
            ready = dict(self._poller.poll(int(left_s * 1000)))
            if self._monitor in ready:
                self._read_events()
            refused = self.problem is not None and self.problem.final
            if self._socket in ready or self._beside in ready or left_s == 0.0 or refused:
                return self._socket in ready

    def _open_monitor(self) -> None:
        name = f"inproc://millrace-worker-{os.urandom(6).hex()}"
        self._socket.monitor(name, WORKER_EVENTS)
        self._monitor = self.context.socket(zmq.PAIR)
        self._monitor.linger = 0
        self._monitor.rcvhwm = 0  # no limit: libzmq blocks if nobody reads, and an environment's step may take minutes
        self._monitor.connect(name)
        self._poller.register(self._monitor, zmq.POLLIN)

    def _read_events(self) -> None:
        """Handle the events that libzmq's monitor has reported about the connection."""
        assert self._monitor is not None
        with suppress(zmq.Again):
            while True:
                event, value = struct.unpack("=HI", self._monitor.recv_multipart(zmq.NOBLOCK)[0])
                if event == zmq.EVENT_DISCONNECTED:
                    if not self.connected and self.problem is None:
                        self._report(
                            ConnectionProblem(f"{self.address} closes the connection at once; is it a millrace learner?")
                        )
                    self.connected = False
                elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                    self.connected = True
                    self.problem = None
                else:
                    self._report(connection_problem(event, value, self.address, self.token))

    def _report(self, problem: ConnectionProblem) -> None:
        self.problem = problem
        if not problem.final and (kept_back := self._log_limiter.due(problem.line, time.monotonic())) is not None:
            log.warning("%s%s", problem.line, suppressed_note(kept_back))

    def receive(self) -> Iterator[ToWorker | BadMessage]:
        """All messages that have arrived. In place of an unreadable message, yields the error."""
        return self._received(decode_to_worker)

    def answers(self) -> Iterator[ToObserver | BadMessage]:
        """All answers to `Inquire` that have arrived; for observers, which are not workers."""
        return self._received(decode_to_observer)

    def _received(self, decode: Callable[[Sequence[Buffer]], Decoded]) -> Iterator[Decoded | BadMessage]:
        while (frames := receive_frames(self._socket)) is not None:
            try:
                yield decode(frames)
            except BadMessage as error:
                yield error

    def send(self, frames: Sequence[Buffer]) -> None:
        """Send a message, or queue it while the learner can't be reached. If a message is lost, heartbeats repair that."""
        with suppress(zmq.Again):
            send_frames(self._socket, frames)

    def connect_again(self) -> None:
        """Drop the connection and make another. Queued messages are lost; heartbeats repair that."""
        self._socket.disconnect(self.address)
        self._socket.connect(self.address)

    def close(self, linger_s: float = LINGER_MS / 1000) -> None:
        """Send queued messages, for at most `linger_s` seconds, and close the socket.

        Call this before the process ends. If its context were still sending at that time, the process would abort, because
        Python frees the frames that libzmq sends.
        """
        if self._monitor is not None and not self._socket.closed:
            self._socket.disable_monitor()  # before the monitor's reader is closed: libzmq blocks without a reader
            self._monitor.close(linger=0)
        self._socket.close(linger=int(linger_s * 1000))
        if self._owns_context:
            self.context.term()
