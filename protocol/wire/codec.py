"""Encodes messages as frames, and decodes them. Pure; all sizes are bounded; nothing is unpickled.

Frame 0 is the head, in msgpack: [type's name, field, field, …] in the order of the record. In place of an array it has
[dtype, shape, index of the array's frame]. Only `Hello` and `Refuse` are maps (fields by name, and the type's name under
`type`), because every version must understand them. Frames 1… are the arrays' raw bytes, C-ordered and little-endian.
Everything that a peer sends is checked before it is used: the number of frames and bytes, the head's size and nesting, every
type, every shape. A received array is a read-only view of its frame, not a copy.

Arrays of a rollout may be packed (`compression.py`). In the head they are [dtype, shape, index, packings]. The receiver
limits the total unpacked size of all packed arrays of a message.
"""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import reduce
from typing import Any, NamedTuple, get_args

import msgpack
import msgspec
import numpy as np

from millrace.protocol.bounds import one_line
from millrace.protocol.env_spec import MAX_CALLABLE_BYTES, PickledCallable
from millrace.protocol.errors import BadMessage, CannotUnpack, UsageError
from millrace.protocol.messages import (
    Described,
    Hello,
    Inquire,
    Refuse,
    Rollout,
    Status,
    ToLearner,
    ToObserver,
    ToWorker,
    Welcome,
)
from millrace.protocol.space_spec import check_size
from millrace.protocol.specs import RunSpec, StepSpec
from millrace.protocol.wire.compression import Packing, raw_bytes, unpack_array
from millrace.protocol.wire.message_sizes import MAX_DIMENSIONS, MAX_FRAME_BYTES, MAX_FRAMES, MAX_HEAD_BYTES, MAX_ITEMS

Buffer = bytes | memoryview

DTYPES = {
    name: np.dtype(name) for name in ("|b1", "|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f2", "<f4", "<f8")
}

MessageTypes = tuple[Any, Any]
"""The message types that are encoded as arrays, and those encoded as maps. msgspec accepts no union of both kinds."""
TO_WORKER: MessageTypes = (reduce(operator.or_, (kind for kind in get_args(ToWorker) if kind is not Refuse)), Refuse)
TO_LEARNER: MessageTypes = (
    reduce(operator.or_, (kind for kind in get_args(ToLearner | Inquire) if kind is not Hello)),
    Hello,
)
TO_OBSERVER: MessageTypes = (Status, Status)

# msgspec builds its type information for a record at the first conversion to it, and crashes the process if two threads do
# so at the same time. All type information is therefore built here, at import, by one thread.
for _kind in (*TO_WORKER, *TO_LEARNER, *TO_OBSERVER):
    with suppress(msgspec.ValidationError):
        msgspec.convert(None, _kind)

assert sys.byteorder == "little", (
    "millrace sends arrays in the byte order of memory and supports only little-endian machines"
)


def encode(message: ToLearner | Inquire | ToWorker | ToObserver, packing: Packing | None = None) -> list[Buffer]:
    """Encode a message as frames. Arrays are not copied, so do not change them afterwards. `packing` applies only to
    rollouts.

    Raises `ValueError` if the head is too long.
    """
    frames: list[Buffer] = [b""]
    packing = packing if isinstance(message, Rollout) else None

    def hook(value: object) -> object:
        if isinstance(value, PickledCallable):
            value = np.frombuffer(value.data, np.uint8)
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{type(message).__name__} cannot carry a {type(value).__name__}")
        if value.dtype.str not in DTYPES:
            raise TypeError(f"{type(message).__name__} cannot carry an array of {value.dtype}")
        described: list[object] = [value.dtype.str, list(value.shape), len(frames)]
        if packing is None:
            frames.append(raw_bytes(value))
            return described
        frame, packings = packing.pack(value)
        frames.append(frame)
        return [*described, packings] if packings else described

    head = _head(message, hook)
    if len(head) > MAX_HEAD_BYTES:
        line = f"{type(message).__name__}: head expected at most {MAX_HEAD_BYTES} bytes, got {len(head)}"
        if isinstance(message, Rollout):
            line += f", for {len(message.episodes)} episodes ended in it; take fewer rollout_steps, or more lanes"
        raise ValueError(line)
    frames[0] = head
    return frames


def _head(message: object, hook: Callable[[object], object]) -> bytes:
    head: bytes = msgpack.packb(msgspec.to_builtins(message, enc_hook=hook, builtin_types=(bytes,)))
    return head


def check_can_be_sent(env: str, run: RunSpec | StepSpec) -> None:
    """Raise `UsageError` if this description of a run is too large for a `Welcome`. `env` names the environment."""
    if (size := len(_head(Welcome(0, 0, run), lambda value: None))) > MAX_HEAD_BYTES:
        raise UsageError(
            f"environment {env}: expected spaces whose description takes at most {MAX_HEAD_BYTES:,} bytes, got {size:,}; "
            "wrap the environment so that its spaces have fewer entries, or so that a MultiDiscrete is a Box of integers"
        )


def decode_to_learner(frames: Sequence[Buffer], packed_bytes_limit: int = 0) -> ToLearner | Inquire:
    """Decode a message from a worker or an observer. Raises `BadMessage` for anything else, and no other error.

    `packed_bytes_limit` is the largest total unpacked size of the message's packed arrays; 0 forbids packed arrays. If only
    these arrays can't be read, the error is a `CannotUnpack`.
    """
    message: ToLearner | Inquire = _decode(frames, TO_LEARNER, packed_bytes_limit)
    return message


def decode_to_worker(frames: Sequence[Buffer]) -> ToWorker:
    """Decode a message from the learner to a worker. Raises `BadMessage` for anything else, and no other error."""
    message: ToWorker = _decode(frames, TO_WORKER, max_items=MAX_HEAD_BYTES)
    return message


def decode_to_observer(frames: Sequence[Buffer]) -> ToObserver:
    """Decode the learner's answer to an observer. Raises `BadMessage` for anything else, and no other error."""
    message: ToObserver = _decode(frames, TO_OBSERVER)
    return message


# rules FRAMES, LIMITS
def _decode(frames: Sequence[Buffer], kinds: MessageTypes, packed_bytes_limit: int = 0, max_items: int = MAX_ITEMS) -> Any:
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise BadMessage(f"message expected 1 to {MAX_FRAMES} frames, got {len(frames)}")
    if len(frames[0]) > MAX_HEAD_BYTES:
        raise BadMessage(f"head expected at most {MAX_HEAD_BYTES} bytes, got {len(frames[0])}")
    by_position, by_name = kinds
    head: object = None
    used: set[int] = set()
    taken = 0

    def hook(wanted: type, value: object) -> object:
        nonlocal taken
        array = _described(frames, value)
        size = array.size
        if array.frame_index in used:
            raise BadMessage(f"array frame {array.frame_index} expected one array, got two")
        used.add(array.frame_index)
        frame = frames[array.frame_index]
        if array.packings is not None:
            taken += size
            if taken > packed_bytes_limit or not packed_bytes_limit:
                line = f"packed arrays expected at most {packed_bytes_limit} bytes together, got {taken}"
                raise CannotUnpack(line, _session_of(head))
            if size > MAX_FRAME_BYTES:
                raise BadMessage(f"packed array expected at most {MAX_FRAME_BYTES} bytes, got {size}")
            try:
                return unpack_array(frame, array.packings, array.dtype, array.shape)
            except BadMessage as error:
                line = one_line(str(error), 500)  # the error may quote text from the peer
                raise CannotUnpack(line, _session_of(head)) from error
        if size != len(frame):
            raise BadMessage(f"array {array.dtype.str}{array.shape} expected {size} bytes, got {len(frame)}")
        if wanted is PickledCallable:
            if size > MAX_CALLABLE_BYTES:
                raise BadMessage(f"callable expected at most {MAX_CALLABLE_BYTES} bytes, got {size}")
            return PickledCallable(bytes(frame))
        return np.ndarray(array.shape, array.dtype, frame if type(frame) is bytes else memoryview(frame).toreadonly())

    try:
        head = msgpack.unpackb(
            frames[0],
            max_array_len=max_items,
            max_map_len=max_items,
            max_ext_len=0,
            strict_map_key=True,
        )
        named = type(head) is dict and "type" in head  # if a map can be of one type only, msgspec accepts it without "type"
        message = msgspec.convert(head, by_name if named else by_position, dec_hook=hook)
    except CannotUnpack:
        raise
    except BadMessage as error:
        raise BadMessage(one_line(str(error), 500)) from error  # the error may quote text from the peer
    except Exception as error:  # msgpack and msgspec raise a dozen types for invalid bytes
        reason = one_line(" ".join(_explain_validation_error(str(error), head, by_position).split()), 200)  # quotes the peer
        raise BadMessage(f"head is not a message of millrace: {type(error).__name__}: {reason}") from error
    if isinstance(message, Described):
        check_size(message.description)
    if len(used) != len(frames) - 1:
        raise BadMessage(f"{type(message).__name__}: expected {len(used)} arrays, got {len(frames) - 1} frames")
    return message


def _explain_validation_error(error: str, head: object, kinds: Any) -> str:
    """The error text of msgspec, with fields named instead of numbered. Counts of fields exclude the type's name."""
    match head:
        case [str() as name, *given]:
            kind = next((kind for kind in get_args(kinds) or (kinds,) if kind.__name__ == name), None)
            fields: tuple[str, ...] = kind.__struct_fields__ if kind is not None else ()
            what, at, where = error.rpartition(" - at `$[")
            place, _, inside = where.partition("]")
            if at and place.isdecimal() and 1 <= int(place) <= len(fields):
                return f"{what} - at `{name}.{fields[int(place) - 1]}{inside}"
            if not at and len(given) != len(fields):
                return f"{name} expected {len(fields)} fields, got {len(given)}"
    return error


def _session_of(head: object) -> int:
    """The session in the head of a message that contains arrays. It is the first field, so it was checked before them."""
    assert type(head) is list
    session: int = head[1]
    return session


class _DescribedArray(NamedTuple):
    """An array, as the head of its message describes it."""

    dtype: np.dtype[Any]
    shape: list[int]
    frame_index: int
    size: int
    """bytes of the array once it is unpacked"""
    packings: list[object] | None


def _described(frames: Sequence[Buffer], value: object) -> _DescribedArray:
    """Parse an array's description in a head: `[dtype, shape, index]`, perhaps with packings. Raises `BadMessage`."""
    if not (type(value) is list and 3 <= len(value) <= 4):
        raise BadMessage(f"array expected [dtype, shape, index], got {str(value)[:80]}")
    name, shape, index = value[:3]
    if not (type(name) is str and type(shape) is list and isinstance(index, int)):
        raise BadMessage(f"array expected [dtype, shape, index], got {str(value)[:80]}")
    dtype = DTYPES.get(name)
    if dtype is None:
        raise BadMessage(f"array dtype expected a supported one, got {name[:20]!r}")
    size = dtype.itemsize
    for side in shape:
        if not (type(side) is int and 0 <= side <= MAX_FRAME_BYTES and len(shape) <= MAX_DIMENSIONS):
            raise BadMessage(f"array shape expected at most {MAX_DIMENSIONS} whole numbers, got {str(shape)[:80]}")
        size *= side
    if type(index) is bool or not 1 <= index < len(frames):
        raise BadMessage(f"array frame expected 1 to {len(frames) - 1}, got {index}")
    packings = value[3] if len(value) == 4 else None
    if packings is not None and type(packings) is not list:
        raise BadMessage(f"array packings expected a list of names, got {str(packings)[:80]}")
    return _DescribedArray(dtype, shape, index, size, packings)
