"""Message <-> frames. Pure: bytes in, records out; bounded; no pickle.

Frame 0 is the head, msgpack: the message's fields under its type's name, each array in its place as
[dtype, shape, index of its frame]. Frames 1… are the arrays' raw bytes, C-ordered, little-endian. Everything a peer says
is checked before it is used: the number of frames and bytes, the head's size and nesting, every type, every shape. An
array that arrives is a read-only view on the received frame: no copy.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import msgpack
import msgspec
import numpy as np
import numpy.typing as npt

from protocol.errors import BadMessage
from protocol.messages import Inquire, ToLearner, ToObserver, ToWorker

Array = npt.NDArray[Any]
Buffer = bytes | memoryview

MAX_FRAMES = 64
MAX_HEAD_BYTES = 1 << 20  # Welcome carries a pickled factory at most this large
MAX_FRAME_BYTES = 1 << 30
MAX_ITEMS = 1 << 16
MAX_DIMENSIONS = 8
DTYPES = {
    name: np.dtype(name) for name in ("|b1", "|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f2", "<f4", "<f8")
}

assert sys.byteorder == "little", "millrace sends arrays as they lie in memory and knows little-endian machines only"


def encode(message: ToLearner | Inquire | ToWorker | ToObserver) -> list[Buffer]:
    """Frames of a message. Arrays are not copied: do not change them afterwards."""
    frames: list[Buffer] = [b""]

    def hook(value: object) -> object:
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{type(message).__name__} cannot carry a {type(value).__name__}")
        if value.dtype.str not in DTYPES:
            raise TypeError(f"{type(message).__name__} cannot carry an array of {value.dtype}")
        frames.append(value.ravel().view(np.uint8).data)
        return [value.dtype.str, list(value.shape), len(frames) - 1]

    head = msgpack.packb(msgspec.to_builtins(message, enc_hook=hook, builtin_types=(bytes,)))
    if len(head) > MAX_HEAD_BYTES:
        raise ValueError(f"{type(message).__name__}: head expected at most {MAX_HEAD_BYTES} bytes, got {len(head)}")
    frames[0] = head
    return frames


def decode_to_learner(frames: Sequence[Buffer]) -> ToLearner | Inquire:
    """What a worker said, or an observer. Raises `BadMessage`, whatever the bytes."""
    message: ToLearner | Inquire = _decode(frames, ToLearner | Inquire)
    return message


def decode_to_worker(frames: Sequence[Buffer]) -> ToWorker:
    """What the learner said. Raises `BadMessage`, whatever the bytes."""
    message: ToWorker = _decode(frames, ToWorker)
    return message


def decode_to_observer(frames: Sequence[Buffer]) -> ToObserver:
    """What the learner answered. Raises `BadMessage`, whatever the bytes."""
    message: ToObserver = _decode(frames, ToObserver)
    return message


def _decode(frames: Sequence[Buffer], kind: Any) -> Any:
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise BadMessage(f"message expected 1 to {MAX_FRAMES} frames, got {len(frames)}")
    if len(frames[0]) > MAX_HEAD_BYTES:
        raise BadMessage(f"head expected at most {MAX_HEAD_BYTES} bytes, got {len(frames[0])}")
    used: set[int] = set()

    def hook(wanted: type, value: object) -> object:
        index, array = _array(frames, value)
        used.add(index)
        return array

    try:
        head = msgpack.unpackb(
            frames[0],
            max_array_len=MAX_ITEMS,
            max_map_len=MAX_ITEMS,
            max_ext_len=0,
            strict_map_key=True,
        )
        message = msgspec.convert(head, kind, dec_hook=hook)
    except BadMessage:
        raise
    except Exception as error:  # msgpack and msgspec raise a dozen types on hostile bytes; to us they are one
        said = " ".join(str(error).split())[:200]  # it quotes the peer
        raise BadMessage(f"head is not a message of ours: {type(error).__name__}: {said}") from error
    if len(used) != len(frames) - 1:
        raise BadMessage(f"{type(message).__name__}: expected {len(used)} arrays, got {len(frames) - 1} frames")
    return message


def _array(frames: Sequence[Buffer], value: object) -> tuple[int, Array]:
    """The array that `[dtype, shape, index]` stands for: a read-only view on its frame."""
    if not (type(value) is list and len(value) == 3):
        raise BadMessage(f"array expected [dtype, shape, index], got {str(value)[:80]}")
    name, shape, index = value
    if not (type(name) is str and type(shape) is list and isinstance(index, int)):
        raise BadMessage(f"array expected [dtype, shape, index], got {str(value)[:80]}")
    dtype = DTYPES.get(name)
    if dtype is None:
        raise BadMessage(f"array dtype expected one of ours, got {name[:20]!r}")
    expected = dtype.itemsize
    for side in shape:
        if not (type(side) is int and 0 <= side <= MAX_FRAME_BYTES and len(shape) <= MAX_DIMENSIONS):
            raise BadMessage(f"array shape expected at most {MAX_DIMENSIONS} whole numbers, got {str(shape)[:80]}")
        expected *= side
    if type(index) is bool or not 1 <= index < len(frames):
        raise BadMessage(f"array frame expected 1 to {len(frames) - 1}, got {index}")
    frame = frames[index]
    if expected != len(frame):
        raise BadMessage(f"array {name}{shape} expected {expected} bytes, got {len(frame)}")
    return index, np.ndarray(shape, dtype, frame if type(frame) is bytes else memoryview(frame).toreadonly())
