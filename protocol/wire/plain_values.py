"""Converts plain values to bytes and back, for `info` dicts and the results of calls. Types are kept. Pure; no pickle.

A value is plain if it is None, a bool, int, float, complex, str, bytes, list, tuple, dict, or a numpy scalar or array of
bools, numbers, text, bytes, dates or durations, or a numpy array of plain objects. Strings with a lone surrogate, which
UTF-8 cannot encode, integers with more decimal digits than Python converts, and dicts whose keys could make them slow
(`_KeyLimit`) are not plain. A value that isn't plain raises `TypeError`; if the caller asks for it, the value is instead
sent as its `repr` and arrives as a `ReprString`, which cannot be confused with a string. For such a caller, subclasses of
dict, list and tuple are plain too: they arrive as dicts, lists and tuples. Other numbers, other sequences, buffers, and
objects with numpy's protocol, such as tensors, arrive as numpy scalars or arrays if numpy reads numbers from them.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import msgpack
import numpy as np

from millrace.protocol.bounds import MOST_OTHER_KEYS, MOST_WITH_ONE_HASH
from millrace.protocol.errors import BadMessage, safe_repr

DTYPE_KINDS = "biufcSUmM"
NUMBER_KINDS = "biuf"
NUMPY_PROTOCOL = ("__array__", "__array_interface__", "__array_struct__")
MAX_DEPTH = 32
MAX_REPR = 1000  # characters

_TUPLE, _PAIRS, _ARRAY, _SCALAR, _OBJECTS, _INT, _COMPLEX, _REPR = range(1, 9)


class ReprString(str):
    """The `repr` of a value that is not plain."""

    __slots__ = ()


class _KeyLimit:
    """Limits the time that the dicts in one value take because of their keys.

    Keys can be chosen so that each collides with all others in its dict. Therefore, the time that a dict takes can grow with
    the square of the number of its keys, and the squares of all dicts are added up. If keys have the same hash, Python also
    compares them with each other, however long they are. Text doesn't count, because Python's hashes of text are secret.
    """

    def __init__(self) -> None:
        self._squares_left = MOST_OTHER_KEYS**2

    def too_slow(self, keys: Iterable[object]) -> bool:
        """Whether a dict with these keys would exceed the limit. If not, it counts from now on."""
        others = [key for key in keys if not isinstance(key, str)]
        squares = len(others) ** 2
        if squares > self._squares_left:
            return True
        if len(others) > MOST_WITH_ONE_HASH and max(Counter(map(hash, others)).values()) > MOST_WITH_ONE_HASH:
            return True
        self._squares_left -= squares
        return False


TOO_SLOW = f"more than {MOST_OTHER_KEYS:,} keys that aren't text, or more than {MOST_WITH_ONE_HASH} with the same hash"


def pack(value: object, use_repr: bool = False) -> bytes:
    """Convert a plain value to bytes. For any other value, packs numbers or its `repr` if `use_repr`; otherwise, raises
    `TypeError`.
    """
    return _pack(_to_msgpack(value, "", use_repr, _KeyLimit(), 0))


def unpack(data: bytes | memoryview) -> Any:
    """The value of these bytes. Raises `BadMessage` for invalid bytes, and no other error.

    The result has at most `MAX_DEPTH` levels, so it is safe to traverse recursively.
    """
    try:
        value = _unpack(data, _KeyLimit(), 0)
        _check_depth(value, 0)
        return value
    except BadMessage:
        raise
    except Exception as error:  # msgpack and numpy raise a dozen types for invalid bytes
        raise BadMessage(f"not a plain value: {type(error).__name__}: {' '.join(str(error).split())[:200]}") from error


def _pack(value: object) -> bytes:
    packed: bytes = msgpack.packb(value)
    return packed


def _to_msgpack(value: Any, where: str, use_repr: bool, limit: _KeyLimit, depth: int) -> Any:
    """Convert a value to types that msgpack knows. Types are compared exactly, so that no subclass arrives as its base
    class.

    `where` is the value's path in errors. Raises `TypeError` for a value that isn't plain, unless `use_repr`.
    """
    if depth > MAX_DEPTH:
        raise TypeError(f"{where or 'value'}: expected at most {MAX_DEPTH} levels, got more")
    kind = type(value)
    if value is None or kind in (bool, float, bytes) or (kind is str and _is_encodable(value)):
        return value
    if kind is int and -(2**63) <= value < 2**64:
        return value
    if kind is int and (digits := _digits(value)) is not None:
        return msgpack.ExtType(_INT, digits)
    if kind is list or (use_repr and isinstance(value, list)):
        return [_to_msgpack(inner, f"{where}[{i}]", use_repr, limit, depth + 1) for i, inner in enumerate(value)]
    if kind is tuple or (use_repr and isinstance(value, tuple)):
        inside = [_to_msgpack(inner, f"{where}[{i}]", use_repr, limit, depth + 1) for i, inner in enumerate(value)]
        return msgpack.ExtType(_TUPLE, _pack(inside))
    if (kind is dict or (use_repr and isinstance(value, dict))) and not limit.too_slow(value):
        inside = [
            _to_msgpack(inner, f"{where}.{key}" if where else str(key), use_repr, limit, depth + 1)
            for key, inner in value.items()
        ]
        if all(type(key) is str and _is_encodable(key) for key in value):
            return dict(zip(value, inside, strict=True))
        keys = [_key(key, f"{where} key", use_repr, limit, depth + 1) for key in value]
        return msgpack.ExtType(_PAIRS, _pack([keys, inside]))
    if kind is complex:
        return msgpack.ExtType(_COMPLEX, _pack([value.real, value.imag]))
    if isinstance(value, np.ndarray) and kind is np.ndarray:
        if value.dtype.kind in DTYPE_KINDS:
            return msgpack.ExtType(_ARRAY, _pack([value.dtype.str, list(value.shape), value.tobytes()]))
        if value.dtype.kind == "O":
            inside = [
                _to_msgpack(inner, f"{where}[{i}]", use_repr, limit, depth + 1)
                for i, inner in enumerate(value.ravel().tolist())
            ]
            return msgpack.ExtType(_OBJECTS, _pack([list(value.shape), inside]))
    if isinstance(value, np.generic) and value.dtype.kind in DTYPE_KINDS:
        return msgpack.ExtType(_SCALAR, _pack([value.dtype.str, value.tobytes()]))
    if use_repr:
        numbers = _numbers(value)
        return _repr(value) if numbers is None else _to_msgpack(numbers, where, use_repr, limit, depth)
    got = {
        str: "text with a lone surrogate",
        int: "an integer with too many digits",
        dict: f"dicts with {TOO_SLOW}",
    }.get(kind, kind.__name__)
    raise TypeError(f"{where or 'value'}: expected plain data (numbers, strings, lists, dicts, arrays), got {got}")


def _key(key: Any, where: str, use_repr: bool, limit: _KeyLimit, depth: int) -> Any:
    """Convert a key of a dict. A key that isn't plain becomes its `repr`, because an array can't be a key."""
    try:
        return _to_msgpack(key, where, False, limit, depth)
    except TypeError:
        if use_repr:
            return _repr(key)
        raise


def _numbers(value: Any) -> Any:
    """The scalar or array that numpy reads from a number or sequence of another type, from a buffer, or from an object with
    numpy's protocol.

    None for other objects, because their items may never end, or if numpy doesn't read numbers from the value.
    """
    try:
        if not isinstance(value, int | float | Sequence) and not any(hasattr(value, name) for name in NUMPY_PROTOCOL):
            memoryview(value)  # raises TypeError if the value isn't a buffer
        array = np.asarray(value)
        return array[()] if array.dtype.kind in NUMBER_KINDS else None
    except Exception:  # user-defined objects may raise anything
        return None


def _repr(value: Any) -> msgpack.ExtType:
    return msgpack.ExtType(_REPR, safe_repr(value)[:MAX_REPR].encode(errors="backslashreplace"))


def _is_encodable(text: str) -> bool:
    """Whether UTF-8 can encode the text."""
    if text.isascii():
        return True
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _digits(value: int) -> bytes | None:
    """The decimal digits of an integer; None if it has more than Python converts (`sys.set_int_max_str_digits`)."""
    try:
        return str(value).encode()
    except ValueError:
        return None


def _unpack(data: bytes | memoryview, limit: _KeyLimit, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise BadMessage(f"plain value: expected at most {MAX_DEPTH} levels, got more")

    def extension(code: int, inside: bytes) -> Any:
        return _from_extension(code, inside, limit, lambda inner: _unpack(inner, limit, depth + 1))

    return msgpack.unpackb(data, ext_hook=extension, strict_map_key=True)


def _check_depth(value: object, depth: int) -> None:
    if depth > MAX_DEPTH:
        raise BadMessage(f"plain value: expected at most {MAX_DEPTH} levels, got more")
    match value:
        case dict():
            for inner in (*value.keys(), *value.values()):
                _check_depth(inner, depth + 1)
        case list() | tuple():
            for inner in value:
                _check_depth(inner, depth + 1)
        case np.ndarray() if value.dtype.kind == "O":
            _check_depth(value.ravel().tolist(), depth)
        case _:
            pass


def _from_extension(code: int, data: bytes, limit: _KeyLimit, inner: Callable[[bytes], Any]) -> Any:
    match code:
        case 1:  # _TUPLE
            return tuple(inner(data))
        case 2:  # _PAIRS
            keys, values = inner(data)
            if limit.too_slow(keys):
                raise BadMessage(f"plain value: got dicts with {TOO_SLOW}")
            return dict(zip(keys, values, strict=True))
        case 3:  # _ARRAY
            dtype, shape, raw = inner(data)
            kind = _dtype(dtype)
            if len(raw) != math.prod(shape) * kind.itemsize:
                raise BadMessage(f"array {dtype}{shape}: expected {math.prod(shape) * kind.itemsize} bytes, got {len(raw)}")
            if not kind.itemsize:  # numpy would allocate a byte for each element
                raise BadMessage(f"array {dtype}{shape}: expected elements of a byte or more")
            _check_characters(raw, kind)
            return np.frombuffer(raw, kind).reshape(shape).copy() if raw else np.zeros(shape, kind)
        case 4:  # _SCALAR
            dtype, raw = inner(data)
            kind = _dtype(dtype)
            _check_characters(raw, kind)
            return np.frombuffer(raw, kind)[0] if kind.itemsize else kind.type()
        case 5:  # _OBJECTS
            shape, values = inner(data)
            array = np.empty(len(values), object)
            array[:] = values
            return array.reshape(shape)
        case 6:  # _INT
            return int(data)
        case 7:  # _COMPLEX
            return complex(*inner(data))
        case 8:  # _REPR
            return ReprString(data.decode())
        case _:
            raise BadMessage(f"plain value: expected a known extension, got {code}")


def _dtype(name: object) -> np.dtype[Any]:
    kind = np.dtype(str(name))
    if kind.kind not in DTYPE_KINDS:
        raise BadMessage(f"array dtype: expected one for plain data, got {str(name)[:20]!r}")
    return kind


def _check_characters(raw: bytes, kind: np.dtype[Any]) -> None:
    """Raise `BadMessage` for invalid characters, because numpy accepts any four bytes, and fails when the text is used."""
    if kind.kind == "U" and raw and (last := int(np.frombuffer(raw, f"{kind.str[0]}u4").max())) > sys.maxunicode:
        raise BadMessage(f"text of {kind.str}: expected characters up to {sys.maxunicode}, got {last}")


def repr_paths(value: object, where: str = "") -> list[str]:
    """The paths inside the value that lead to a `ReprString`."""
    match value:
        case ReprString():
            return [where]
        case dict():
            return [at for key, inner in value.items() for at in repr_paths(inner, f"{where}.{key}" if where else str(key))]
        case list() | tuple():
            return [at for inner in value for at in repr_paths(inner, where)]
        case np.ndarray() if value.dtype.kind == "O":
            return [at for inner in value.ravel().tolist() for at in repr_paths(inner, where)]
        case _:
            return []
