"""What the sockets of both sides share: options, receiving and sending a message, counting traffic.

An experiment taught us each option. MAXMSGSIZE bounds a frame before a byte of it is read. TCP_MAXRT and keepalive close a
connection whose other end has vanished; the worker makes a new one within seconds. There are no ZMTP heartbeats: while a
reader is stopped by its high-water mark, they lose and reorder messages. Our own heartbeats detect silence, and tickets keep
queues short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import zmq

from protocol.address import needs_ipv6
from protocol.keys.handshake import HANDSHAKE_MS
from protocol.wire.codec import MAX_FRAME_BYTES, MAX_FRAMES, Buffer

LINGER_MS = 2000
UNACKNOWLEDGED_MS = 5000  # TCP doubles its retry interval: after a cut it may need as long again as the cut lasted
QUEUE = 1000  # messages that wait for a peer that does not read
COPY_BELOW_BYTES = 65536  # copying a smaller frame is cheaper than tracking it
CURVE_BYTES = 33  # what encryption adds to a frame
NOT_WAITING, AND_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)


def set_options(socket: zmq.Socket[bytes], address: str, curve: bool) -> None:
    """Set the options that both sides need, before the socket binds or connects."""
    socket.linger = LINGER_MS
    socket.maxmsgsize = MAX_FRAME_BYTES + (CURVE_BYTES if curve else 0)
    socket.handshake_ivl = HANDSHAKE_MS
    socket.connect_timeout = 2000
    socket.tcp_maxrt = UNACKNOWLEDGED_MS
    # Without keepalive, the connection to a host that vanished while idle would stay forever.
    socket.tcp_keepalive, socket.tcp_keepalive_idle, socket.tcp_keepalive_intvl, socket.tcp_keepalive_cnt = 1, 15, 5, 3
    socket.ipv6 = needs_ipv6(address)
    # These limits are never reached: at most one Weights message, a few tickets and their rollouts are on their way.
    socket.sndhwm = socket.rcvhwm = QUEUE


def receive_frames(socket: zmq.Socket[bytes], sender_keys: list[str] | None = None) -> list[Buffer] | None:
    """The frames of the next message, or None if no message has arrived.

    At most `MAX_FRAMES` + 2 frames are kept, so that the caller can see that there were too many. If `sender_keys` is given,
    its content is replaced by one key: that of the message's sender, which libzmq proved in the handshake.
    """
    frames: list[Buffer] = []
    try:
        more = True
        while more:
            frame = socket.recv(NOT_WAITING, copy=False)
            if sender_keys is not None and not frames:
                sender_keys[:] = [_user(frame)]
            more = frame.more
            if len(frames) < MAX_FRAMES + 2:  # + sender's name, + one that shows there were too many
                frames.append(frame.buffer if len(frame) >= COPY_BELOW_BYTES else frame.bytes)
    except zmq.Again:
        return None
    return frames


def send_frames(socket: zmq.Socket[bytes], frames: Sequence[Buffer]) -> None:
    """Faster `send_multipart`, whose checks of flags and types for each frame are half the cost of sending."""
    for frame in frames[:-1]:
        socket.send(frame, AND_MORE, copy=False)
    socket.send(frames[-1], NOT_WAITING, copy=False)


def _user(frame: zmq.Frame) -> str:
    try:
        return str(frame.get("User-Id"))
    except zmq.ZMQError:  # no key is present, which must not happen; no client has this key
        return ""


@dataclass
class Traffic:
    """Traffic in one direction. Bytes count all frames before encryption, the worker's name included."""

    messages: int = 0
    bytes: int = 0

    def add(self, frames: Sequence[Buffer]) -> None:
        """Count one more message."""
        self.messages += 1
        self.bytes += sum(map(len, frames))
