"""A peer that sends invalid data: random bytes, and ZeroMQ messages with random frames. It can run as a separate process.

Rule: the seed decides what it sends.
"""

from __future__ import annotations

import random
import socket
import sys

import zmq

from millrace.protocol.messages import Heartbeat, Hello
from millrace.protocol.wire.codec import encode
from tests.support.conversation.example_messages import example

NAME = b"stranger"


def talk_rubbish(host: str, port: int, seed: int, *, connections: int = 100, messages: int = 300) -> bool:
    """Send random bytes over some connections, then messages with random frames. Returns whether the learner answered."""
    noise = random.Random(seed)
    for _ in range(connections):
        with socket.create_connection((host, port), timeout=10) as raw:
            raw.sendall(noise.randbytes(500))
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        stranger = context.socket(zmq.DEALER)
        stranger.linger, stranger.sndtimeo, stranger.routing_id = 0, 10_000, NAME
        stranger.connect(f"tcp://{host}:{port}")
        for number in range(messages):
            stranger.send_multipart([noise.randbytes(noise.randrange(2000)) for _ in range(1 + number % 80)])
        hello = example(Hello, worker=NAME.decode(), software="")
        stranger.send_multipart([*encode(hello), b"one frame too many"])
        stranger.send_multipart(encode(example(Heartbeat, session=7)))
        return bool(stranger.poll(10_000))
    except zmq.Again:  # the learner does not let it in, and its queue is full
        return False
    finally:
        context.destroy(linger=0)


if __name__ == "__main__":
    talk_rubbish(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
