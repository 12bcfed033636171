"""Options of the sockets of both sides, and the routing id of a worker. Imports no numpy.

Each option was found by experiment. MAXMSGSIZE bounds the size of a frame before any of it is read. TCP_MAXRT and keepalive
close a connection whose other end has vanished; the worker makes a new one within seconds. ZMTP heartbeats are off, because
they lose and reorder messages while a reader is stopped by its high-water mark. Our own heartbeats detect silence, and
tickets keep queues short.
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import zmq

from millrace.protocol.address import needs_ipv6
from millrace.protocol.keys.handshake_failures import HANDSHAKE_MS
from millrace.protocol.keys.keys import Token
from millrace.protocol.wire.message_sizes import MAX_FRAME_BYTES

LINGER_MS = 2000
UNACKNOWLEDGED_MS = 5000  # short, because TCP doubles its retry interval, so recovery may take as long as the outage
QUEUE = 1000  # messages that may wait for a peer that does not read
RECONNECT_MS = 100
RECONNECT_MOST_MS = 2000
CURVE_BYTES = 33  # bytes that encryption adds to a frame
TAG_CHARACTERS = 32


class Limits(NamedTuple):
    """Limits on what this end accepts from the other end and queues for it."""

    frame_bytes: int
    messages: int
    """number of messages that may wait to be read or sent"""


def set_options(socket: zmq.Socket[bytes], address: str, curve: bool, limits: Limits | None = None) -> None:
    """Set the options that both sides need, before the socket binds or connects.

    If `limits` is None, they are those of workers and learners.
    """
    limits = limits or Limits(MAX_FRAME_BYTES, QUEUE)
    socket.linger = LINGER_MS
    socket.maxmsgsize = limits.frame_bytes + (CURVE_BYTES if curve else 0)
    socket.handshake_ivl = HANDSHAKE_MS
    socket.connect_timeout = 2000
    socket.tcp_maxrt = UNACKNOWLEDGED_MS
    # Without keepalive, the connection to a host that vanished while idle would stay forever.
    socket.tcp_keepalive = 1
    socket.tcp_keepalive_idle = 15
    socket.tcp_keepalive_intvl = 5
    socket.tcp_keepalive_cnt = 3
    socket.ipv6 = needs_ipv6(address)
    # A worker never reaches its limit: at most one Weights message, a few tickets and their rollouts are in transit.
    socket.sndhwm = socket.rcvhwm = limits.messages


def routing_id(name: str, token: Token | None) -> bytes:  # rule ROUTING_ID
    """The worker's name; with a token, it is followed by a tag that only the holder of the token can compute."""
    if token is None:
        return name.encode()
    tag = hashlib.blake2b(name.encode(), key=token.client.secret, digest_size=TAG_CHARACTERS // 2)
    return b"%s\0%s" % (name.encode(), tag.hexdigest().encode())
