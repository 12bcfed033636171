"""Messages that nobody should send, made from a seed: random bytes, damaged and twisted real ones, lies about lengths."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgpack
import msgspec
import numpy as np

from millrace.protocol.messages import Inquire, ToLearner
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.compression import Packing
from tests.support.conversation.every_message import to_learner
from tests.support.conversation.fake_ends import fake_rollout, seated_rollout

Frames = list[bytes]

HUGE = [
    b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff",
    b"\xc9\xff\xff\xff\xff\x01", b"\xdc\xff\xff", b"\xde\xff\xff", b"\x91" * 5_000, b"\x81\xa1a" * 2_000,
    b"\xdd\x00\x0f\xff\xff" + b"\x90" * 1_000_000,
]  # fmt: skip
NONSENSE: list[Any] = [
    None, True, -1, 2**63, -(2**63), 1e308, float("nan"), "", "x" * 10_000, b"\x00" * 100, [], {}, [[[[[[]]]]]],
    {"type": "Hello"}, ["Goodbye"], ["|O", [1], 1], ["O", [1], 1], ["|V16", [1], 1], ["|S5", [1], 1], ["<M8[s]", [1], 1],
    [">f4", [1], 1], ["<f4", [-1], 1], ["<f4", [-2, -2], 1], ["<f4", [2**31, 2**31], 1], ["<f4", [0, 2**40], 1],
    ["<f4", [1] * 40, 1], ["|u1", [17, 1, 4, 8, 8], 1, ["stack"]], ["|u1", [2**9, 2, 16, 8, 8], 1, ["stack"]],
    ["<f4", [1], 1, []], ["stack"], ["<f4", [1], 0], ["<f4", [1], -1], ["<f4", [1], 99], ["<f4", [True], 1],
    ["<f8", [1.5], 1], ["<f4", "12", 1],
]  # fmt: skip


def real(session: int) -> list[ToLearner | Inquire]:
    """One good message of each kind that a learner can be told; rollouts also of seats, and with frames that go packed."""
    frames = np.lib.stride_tricks.sliding_window_view(np.arange(16 + 4, dtype=np.uint8), 4)[:, None, :, None, None]
    packed = msgspec.structs.replace(fake_rollout(session, 0, 0, 0, 0), obs=(np.tile(frames, (8, 8)),))
    return [*to_learner(session), packed, seated_rollout(session), Inquire()]


def hostile(seed: int, messages: Sequence[Any]) -> Iterator[Frames]:
    """Without end."""
    rng = np.random.default_rng(seed)
    frames = [[bytes(frame) for frame in encode(message, Packing(stack=True))] for message in messages]
    kinds: list[Callable[[np.random.Generator, Frames], Frames]] = [
        _random, _flipped, _cut, _doubled, _twisted, _twisted, _misplaced, _lying, _as_it_is,
    ]  # fmt: skip
    while True:
        yield kinds[rng.integers(len(kinds))](rng, list(frames[rng.integers(len(frames))]))


def _random(rng: np.random.Generator, frames: Frames) -> Frames:
    return [rng.bytes(int(rng.integers(200))) for _ in range(rng.integers(1, 5))]


def _flipped(rng: np.random.Generator, frames: Frames) -> Frames:
    at = int(rng.integers(len(frames)))
    damaged = bytearray(frames[at] or b"\x00")
    for _ in range(rng.integers(1, 5)):
        damaged[rng.integers(len(damaged))] ^= 1 << int(rng.integers(8))
    frames[at] = bytes(damaged)
    return frames


def _cut(rng: np.random.Generator, frames: Frames) -> Frames:
    at = int(rng.integers(len(frames)))
    frames[at] = frames[at][: rng.integers(len(frames[at]) + 1)]
    return frames[: rng.integers(1, len(frames) + 1)]


def _doubled(rng: np.random.Generator, frames: Frames) -> Frames:
    return frames + [frames[rng.integers(len(frames))]] * int(rng.integers(1, 70))


def _twisted(rng: np.random.Generator, frames: Frames) -> Frames:
    """One value of the head, at any depth, is something else."""
    head = msgpack.unpackb(frames[0])
    place = head
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            break
        key = keys[rng.integers(len(keys))]
        if isinstance(place[key], dict | list) and place[key] and rng.random() < 0.6:
            place = place[key]
            continue
        place[key] = NONSENSE[rng.integers(len(NONSENSE))]
        break
    try:
        frames[0] = msgpack.packb(head)
    except OverflowError:
        frames[0] = msgspec.msgpack.encode(None)
    return frames


def _misplaced(rng: np.random.Generator, frames: Frames) -> Frames:
    """One field of the head is left out, said twice, or changes places with another."""
    head = msgpack.unpackb(frames[0])
    fields = list(head.items()) if isinstance(head, dict) else head
    one, other = (int(rng.integers(len(fields))) for _ in range(2))
    match rng.integers(3):
        case 0:
            del fields[one]
        case 1:
            fields.insert(other, fields[one])
        case _:
            fields[one], fields[other] = fields[other], fields[one]
    frames[0] = msgpack.packb(dict(fields) if isinstance(head, dict) else fields)
    return frames


def _lying(rng: np.random.Generator, frames: Frames) -> Frames:
    frames[0] = HUGE[rng.integers(len(HUGE))] + (frames[0] if rng.random() < 0.5 else b"")
    return frames


def _as_it_is(rng: np.random.Generator, frames: Frames) -> Frames:
    """Well said, but of a session that is not the sender's."""
    return frames
