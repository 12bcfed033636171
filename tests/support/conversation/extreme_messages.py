"""Every field of every message that a worker can send, at extreme values. Made from the types of the records.

Rule: each message differs from a good one in one place, at any depth: a number at its bounds and beyond them, NaN, infinity,
a text that is too long, or holds control characters, markup or bytes that are no UTF-8, a list that is empty or too long, a
value of another type, an array of another shape, dtype or content.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import msgpack
import msgspec
import msgspec.inspect as mi
import numpy as np

from millrace.protocol.wire.codec import DTYPES, encode

MARK = "\x1b[7777m"
"""A sequence that nobody else writes. Where it is shown as it is, a peer can control the terminal."""
TEXTS = [
    "", "[/red]", "[bold red on white blink]", f"{MARK}[red]", "a\nb", "a\r2026-11-22 05:00:00,000 learner: all is well",
    "\x00", "\x9b31m", "\u202e\u2066", "\u2028", "é" * 200, "%s%d{0}{x}", "<script>alert(1)</script>", "../../etc/passwd",
    "x" * 900_000,
]  # fmt: skip
OTHERS: list[Any] = [None, True, -1, 1.5, "text", b"bytes", [], {}, [[[[[]]]]], 2**64 - 1]
NOT_UTF8 = "\udcff\udced\udca0\udc80"  # packed with `surrogateescape`: bytes that are no text


SESSION = 2**40 + 7
"""The session of messages that are made before their sender knows its own; see `of_session`."""


def of_session(frames: list[bytes], session: int) -> list[bytes]:
    """The same frames, said in this session."""
    return [frames[0].replace(_session(SESSION), _session(session)), *frames[1:]]


def _session(number: int) -> bytes:
    return b"\xcf" + number.to_bytes(8, "big")


def extremes(message: Any) -> Iterator[list[bytes]]:
    """Frames of messages like this one. Some of them are good messages, with values at their bounds."""
    frames = [bytes(frame) for frame in encode(message)]
    head = msgpack.unpackb(frames[0])
    for changed in _fields(mi.type_info(type(message)), head):
        yield [_packed(changed), *frames[1:]]
    for number, frame in enumerate(frames[1:], 1):
        for other in (b"", frame[:-1], frame + b"\x00", b"\xff" * len(frame), frame * 2):
            yield [*frames[:number], other, *frames[number + 1 :]]
    yield [*frames, b"more"]
    if len(frames) > 1:
        yield frames[:-1]
    yield frames * 70
    for changed_array in _arrays(message):
        yield [bytes(frame) for frame in encode(changed_array)]


def _packed(head: Any) -> bytes:
    packed: bytes = msgpack.packb(head, unicode_errors="surrogateescape")
    return packed


# ---------------------------------------------------------------- heads, by the types of the fields


def _fields(kind: mi.Type, value: Any) -> Iterator[Any]:
    """Heads that differ from this one in one place. The head of a message or of a record: a list, or a map."""
    assert isinstance(kind, mi.StructType)
    keys: Sequence[Any]
    if isinstance(value, dict):
        keys = [field.encode_name for field in kind.fields]
    else:
        keys = range(int(kind.tag is not None), int(kind.tag is not None) + len(kind.fields))
    for key, field in zip(keys, kind.fields, strict=True):
        if isinstance(value, list) and key >= len(value):
            continue
        for changed in _values(field.type, value[key]):
            yield _with(value, key, changed)
    if isinstance(value, list):
        yield value[:-1]
        yield [*value, 0]
        yield ["Nobody", *value[1:]]


def _with(value: Any, key: Any, changed: Any) -> Any:
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[key] = changed
    return copy


def _values(kind: mi.Type, value: Any) -> Iterator[Any]:
    yield from OTHERS
    match kind:
        case mi.IntType(ge=least, le=most):
            for bound in (least, most):
                if bound is not None:
                    yield from (bound - 1, bound, bound + 1)
            yield from (0, 1, 2**31, 2**53, 2**63, 2**64 - 1, -(2**63))
        case mi.FloatType(ge=least, le=most):
            bounds = [bound for bound in (least, most) if bound is not None and abs(bound) < 1e300]
            yield from (
                math.nan,
                math.inf,
                -math.inf,
                1e308,
                -1e308,
                5e-324,
                -0.0,
                *bounds,
                *(bound + 1 for bound in bounds),
            )
        case mi.StrType(max_length=most):
            yield from TEXTS
            yield NOT_UTF8
            if most is not None:
                yield from ("m" * most, "m" * (most + 1), "\U0001f600" * most)
        case mi.LiteralType(values=values):
            yield from (*values, *TEXTS)
        case mi.VarTupleType(item_type=inner, max_length=most) | mi.ListType(item_type=inner, max_length=most):
            yield from ([value], value * 3)
            for first in [value[0] if value else 0]:
                yield [first] * min(most + 1, 70_000) if most is not None else [first] * 70_000
                if most is not None:
                    yield [first] * min(most, 60_000)
                if value:
                    for changed in _values(inner, first):
                        yield [changed, *value[1:]]
        case mi.DictType(value_type=inner):
            yield {f"stage {n}": 1.0 for n in range(45_000)}
            yield from ({text: 1.0} for text in TEXTS)
            for key in value:
                for changed in _values(inner, value[key]):
                    yield {**value, key: changed}
        case mi.UnionType(types=types):
            for inner in types:
                if not isinstance(inner, mi.StructType) or (isinstance(value, list) and value[:1] == [inner.tag]):
                    yield from _values(inner, value)
        case mi.StructType():
            nested = value
            for _ in range(200):
                nested = [nested]
            yield nested
            yield from _fields(kind, value)
        case mi.CustomType():
            yield from _descriptions(value)
        case _:
            pass


def _descriptions(value: Any) -> Iterator[Any]:
    """What is said of an array: dtype, shape, frame."""
    if not (isinstance(value, list) and len(value) == 3):
        return
    dtype, shape, index = value
    for other in (*DTYPES, "|O", ">f8", "|S8", *TEXTS):
        yield [other, shape, index]
    for sides in (
        [],
        [0],
        [-1],
        [2**31, 2**31],
        [0, 2**40],
        [1] * 40,
        [1.5],
        ["x"],
        [True],
        [2**64 - 1],
        shape[::-1],
        [*shape, 1],
    ):
        yield [dtype, sides, index]
    for frame in (0, -1, index + 1, 2**63, None, "1", 1.0, True):
        yield [dtype, shape, frame]
    yield from ([*value, []], [*value, ["stack"]], [*value, ["zstd"]], [*value, [MARK]], [*value, MARK], value[:2])


# ---------------------------------------------------------------- arrays that are what they say


def _arrays(message: Any) -> Iterator[Any]:
    """Messages with another array in one field."""
    for field in type(message).__struct_fields__:
        value = getattr(message, field)
        if isinstance(value, np.ndarray):
            for other in _other_arrays(value):
                yield msgspec.structs.replace(message, **{field: other})
        elif isinstance(value, tuple) and value and all(isinstance(one, np.ndarray) for one in value):
            for other in _other_arrays(value[0]):
                yield msgspec.structs.replace(message, **{field: (other, *value[1:])})
            yield msgspec.structs.replace(message, **{field: ()})
            yield msgspec.structs.replace(message, **{field: value * 2})


def _other_arrays(array: np.ndarray[Any, Any]) -> Iterator[np.ndarray[Any, Any]]:
    for dtype in DTYPES.values():
        yield array.astype(dtype)
    for name, values in (("<f4", (math.nan, math.inf, 3e38)), ("<i8", (-(2**63), 2**63 - 1)), ("|u1", (255,))):
        yield from (np.full(array.shape, one, name) for one in values)
    if array.dtype == bool:
        yield np.full(array.shape, 255, np.uint8).view(bool)
        yield ~array
    if array.dtype.kind == "f":
        yield np.full(array.shape, math.nan, array.dtype)
    for shape in ((), (0,), (0, *array.shape), (1, *array.shape), (*array.shape, 0)):
        yield np.zeros(shape, array.dtype)
    yield np.zeros(1_000_000 // array.itemsize, array.dtype)
