"""Converts plain values to bytes and back, for `info` dicts and the results of calls. Types are kept. Pure; no pickle.

A value is plain if it is None, a bool, int, float, complex, str, bytes, list, tuple, dict, or a numpy scalar or array of
bools, numbers, text, bytes, dates or durations, or a numpy array of plain objects. Strings with a lone surrogate, which
UTF-8 cannot encode, integers with more decimal digits than Python converts, and dicts whose keys could make them slow
(`_too_slow`) are not plain. An array of text of length 0 arrives as one of length 1, which has the same elements. A value
that isn't plain raises `TypeError`; if the caller asks for it, the value is instead sent as its `repr` and arrives as a
`ReprString`, which cannot be confused with a string. For such a caller, subclasses of dict, list and tuple are plain too:
they arrive as dicts, lists and tuples. Other numbers, buffers, and objects with numpy's protocol, such as tensors, arrive
as numpy scalars or arrays if numpy reads numbers from them. A deque arrives as a list. Other sequences don't, because some
never end, or contain themselves, as a character of a `UserString` does. A container that contains itself isn't plain; nor
is one below `MAX_DEPTH` levels. A container that occurs in several places is sent in each of them, so that a small value
could take 2^32 times its own size; therefore containers aren't plain either after `MOST_REPEATED` values that were sent
before. A container that isn't plain is sent as a line that says why, because its `repr` would be as long.
"""

from __future__ import annotations

import math
import sys
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import partial
from typing import Any

import msgpack
import numpy as np

from millrace.protocol.bounds import MAX_LINE, MAX_NAME, MOST_OTHER_KEYS, MOST_WITH_ONE_HASH, one_line
from millrace.protocol.errors import BadMessage, safe_repr
from millrace.protocol.key_limit import KeyLimit

DTYPE_KINDS = "biufcSUmM"
NUMBER_KINDS = "biuf"
NUMPY_PROTOCOL = ("__array__", "__array_interface__", "__array_struct__")
MAX_DEPTH = 32
MOST_REPEATED = 1 << 20  # values in containers that occur again inside one value
MAX_REPR = 1000  # characters
MAX_DIMENSIONS = 64  # numpy's own limit
MAX_SIZE = 1 << 48  # of one dimension
MAX_DTYPE = 40  # characters of numpy's name of a dtype


class _Code(IntEnum):
    """Codes of msgpack's extensions: the types that msgpack itself doesn't have."""

    TUPLE = 1
    PAIRS = 2  # a dict with keys that msgpack doesn't take
    ARRAY = 3
    SCALAR = 4
    OBJECTS = 5
    INT = 6
    COMPLEX = 7
    REPR = 8


_NOT_MSGPACK = (_Code.INT, _Code.REPR)
"""Extensions whose payload isn't msgpack."""


class ReprString(str):
    """The `repr` of a value that is not plain, or a line that says why a container is not."""

    __slots__ = ()


ITSELF = "that contains itself"
TOO_SLOW = (
    f"more than {MOST_OTHER_KEYS:,} keys that aren't text, more than {MOST_WITH_ONE_HASH} with the same hash, "
    "or too many such dicts"
)


def pack(value: object, use_repr: bool = False) -> bytes:
    """Convert a plain value to bytes. For any other value, packs numbers or its `repr` if `use_repr`; otherwise, raises
    `TypeError`.
    """
    return _pack(_converted(value, use_repr))


def pack_each(values: Iterable[object], use_repr: bool = False) -> bytes:
    """Convert a list of values, such as one for each env copy, to bytes. How a value arrives, and whether it is plain,
    doesn't depend on the other values, because the number of values in a message follows from the number of workers.
    """
    return _pack([_converted(each, use_repr, f"[{n}]", 1) for n, each in enumerate(values)])


def unpack(data: bytes | memoryview, values: int = 1) -> Any:
    """The value of these bytes, or a list that `pack_each` has packed, with at most this number of values. Raises
    `BadMessage` for invalid bytes, and no other error.

    The result has at most `MAX_DEPTH` levels, so it is safe to traverse recursively.
    """
    try:
        value = _unpack(data, KeyLimit(values), 0)
        _check_depth(value, 0)
        return value
    except BadMessage:
        raise
    except Exception as error:  # msgpack and numpy raise a dozen types for invalid bytes
        raise BadMessage(f"not a plain value: {type(error).__name__}: {' '.join(str(error).split())[:200]}") from error


def _pack(value: object) -> bytes:
    packed: bytes = msgpack.packb(value)
    return packed


class _NotPlain(TypeError):
    """A value that isn't plain. Its path is composed only for the error, because the `str` of a key may raise."""

    def __init__(self, why: str) -> None:
        super().__init__(why)
        self.why = why
        self.steps: list[str] = []
        """the path to the value inside the outermost one, the last step first"""


class _Cycle(Exception):
    """A container contains itself. This ends when all that is inside that container has been left."""

    def __init__(self, container: object) -> None:
        super().__init__()
        self.container = container


def _converted(value: object, use_repr: bool, where: str = "", depth: int = 0) -> Any:
    """Convert a value to types that msgpack knows. `where` is its path in errors, and `depth` its level."""
    try:
        return _Packer(use_repr).convert(value, depth)
    except _NotPlain as error:
        path = "".join((where, *reversed(error.steps))).removeprefix(".")
        raise TypeError(f"{path or 'value'}: {error.why}") from None


@dataclass(slots=True)
class _Places:
    """The containers inside one value, which may occur in several places."""

    met: dict[int, object] = field(default_factory=dict)
    """by `id`, each container so far, which keeps it from being freed, so that no other one gets its `id`"""
    around: set[int] = field(default_factory=set)
    """`id` of each container that contains the current value"""
    refused: dict[int, str] = field(default_factory=dict)
    """by `id`, containers that aren't plain in any place, and why"""
    repeated: int = 0
    """how many values were in containers that had occurred before"""

    def enter(self, container: Any) -> bool:
        """Record that a container occurs. Returns False if too many values have occurred before."""
        if id(container) not in self.met:
            self.met[id(container)] = container
        else:
            self.repeated += 1 + len(container)
        return self.repeated <= MOST_REPEATED


@dataclass(frozen=True, slots=True)
class _Packer:
    """Converts one value to types that msgpack knows. Types are compared exactly, so that no subclass arrives as its base
    class; with `use_repr`, subclasses of list, tuple and dict do.
    """

    use_repr: bool
    limit: KeyLimit = field(default_factory=KeyLimit)
    places: _Places = field(default_factory=_Places)

    def convert(self, value: Any, depth: int) -> Any:
        """Raises `_NotPlain` for a value that isn't plain, unless `use_repr`."""
        if depth > MAX_DEPTH:
            raise _NotPlain(f"expected at most {MAX_DEPTH} levels, got more")
        kind = type(value)
        if value is None or kind in (bool, float, bytes) or (kind is str and _is_encodable(value)):
            return value
        if kind is int and -(2**63) <= value < 2**64:
            return value
        if kind is int and (digits := _digits(value)) is not None:
            return msgpack.ExtType(_Code.INT, digits)
        if self._is_container(value):
            return self._container(value, depth)
        if kind is complex:
            return msgpack.ExtType(_Code.COMPLEX, _pack([value.real, value.imag]))
        if kind is np.ndarray and value.dtype.kind in DTYPE_KINDS and _can_be_shown(value):
            if not value.dtype.itemsize:  # the reader refuses such an array, because its shape could be of any size
                value = value.astype(f"{value.dtype.kind}1")
            return msgpack.ExtType(_Code.ARRAY, _pack([value.dtype.str, list(value.shape), value.tobytes()]))
        if isinstance(value, np.generic) and value.dtype.kind in DTYPE_KINDS and _can_be_shown(value):
            return msgpack.ExtType(_Code.SCALAR, _pack([value.dtype.str, value.tobytes()]))
        if self.use_repr:
            numbers = _numbers(value)
            return _repr(value) if numbers is None else self.convert(numbers, depth)
        got = {str: "text with a lone surrogate", int: "an integer with too many digits"}.get(kind, kind.__name__)
        raise _unexpected(got)

    def _is_a(self, kind: type, value: object) -> bool:
        return type(value) is kind or (self.use_repr and isinstance(value, kind))

    def _is_container(self, value: Any) -> bool:
        if type(value) is np.ndarray:
            return bool(value.dtype.kind == "O")
        if self._is_a(dict, value) or self._is_a(list, value) or self._is_a(tuple, value):
            return True
        return self.use_repr and isinstance(value, deque)

    def _why_not_plain(self, container: Any, depth: int) -> str:
        """Why a container isn't plain in this place; empty if it is. If it is, its keys count."""
        if why := self.places.refused.get(id(container)):
            return why
        if self.use_repr and depth == MAX_DEPTH:
            return f"below {MAX_DEPTH} levels"
        if not self.places.enter(container):
            return f"after {MOST_REPEATED:,} values that were sent before"
        if isinstance(container, dict) and _too_slow(container, self.limit):
            self.places.refused[id(container)] = f"with {TOO_SLOW}"
        return self.places.refused.get(id(container), "")

    def _instead(self, container: object, why: str) -> Any:
        """What is sent instead of a container that isn't plain. Raises `_NotPlain` unless `use_repr`."""
        got = f"{type(container).__name__} {why}"
        if self.use_repr:
            return _line(f"<{got}>")
        raise _unexpected(got)

    def _container(self, value: Any, depth: int) -> Any:
        if id(value) in self.places.around:
            raise _Cycle(value)
        if why := self._why_not_plain(value, depth):
            return self._instead(value, why)
        self.places.around.add(id(value))
        try:
            if isinstance(value, dict):
                return self._dict(value, depth)
            items = self._items(value.ravel().tolist() if isinstance(value, np.ndarray) else value, depth)
            if isinstance(value, tuple):
                return msgpack.ExtType(_Code.TUPLE, _pack(items))
            if isinstance(value, np.ndarray):
                return msgpack.ExtType(_Code.OBJECTS, _pack([list(value.shape), items]))
            return items
        except _Cycle as cycle:
            if cycle.container is not value:
                raise
            self.places.refused[id(value)] = ITSELF
            return self._instead(value, ITSELF)
        finally:
            self.places.around.discard(id(value))

    def _items(self, values: Iterable[Any], depth: int) -> list[Any]:
        items = []
        for n, each in enumerate(values):
            try:
                items.append(self.convert(each, depth + 1))
            except _NotPlain as error:
                error.steps.append(f"[{n}]")
                raise
        return items

    def _dict(self, value: dict[Any, Any], depth: int) -> Any:
        inside = []
        for key, each in value.items():
            try:
                inside.append(self.convert(each, depth + 1))
            except _NotPlain as error:
                error.steps.append(f".{key if type(key) is str else safe_repr(key)}")
                raise
        if all(type(key) is str and _is_encodable(key) for key in value):
            return dict(zip(value, inside, strict=True))
        keys = [self._key(key, depth + 1) for key in value]
        return msgpack.ExtType(_Code.PAIRS, _pack([keys, inside]))

    def _key(self, key: Any, depth: int) -> Any:
        """Convert a key of a dict. A key that isn't plain becomes its `repr`, because an array or a list can't be a key."""
        try:
            return replace(self, use_repr=False).convert(key, depth)
        except _NotPlain as error:
            if self.use_repr:
                return _repr(key)
            error.steps.append(" key")
            raise


def _unexpected(got: str) -> _NotPlain:
    return _NotPlain(f"expected plain data (numbers, strings, lists, dicts, arrays), got {got}")


def _too_slow(keys: Iterable[object], limit: KeyLimit) -> bool:
    """Whether a dict with these keys would take too long. If not, they count from now on.

    If keys have the same hash, Python also compares them with each other, however long they are.
    """
    others = [key for key in keys if not isinstance(key, str)]
    if not limit.allows(len(others)):  # first, because a Counter is a dict too
        return True
    return len(others) > MOST_WITH_ONE_HASH and max(Counter(map(hash, others)).values()) > MOST_WITH_ONE_HASH


def _numbers(value: Any) -> Any:
    """The scalar or array that numpy reads from a number of another type, from a buffer, or from an object with numpy's
    protocol.

    None for anything else. numpy would also read sequences, but some never end, and it gives each text in a sequence the
    length of the longest one.
    """
    try:
        if not isinstance(value, int | float) and not any(hasattr(value, name) for name in NUMPY_PROTOCOL):
            memoryview(value)  # raises TypeError if the value isn't a buffer
        array = np.asarray(value)
        return array[()] if array.dtype.kind in NUMBER_KINDS else None
    except Exception:  # user-defined objects may raise anything
        return None


def _repr(value: Any) -> msgpack.ExtType:
    return _line(safe_repr(value))


def _line(text: str) -> msgpack.ExtType:
    """A text that arrives as a `ReprString`."""
    return msgpack.ExtType(_Code.REPR, text[:MAX_REPR].encode(errors="backslashreplace"))


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


def _unpack(data: bytes | memoryview, limit: KeyLimit, depth: int) -> Any:
    if depth > MAX_DEPTH + 1:  # an extension on the last level has a payload
        raise BadMessage(f"plain value: expected at most {MAX_DEPTH} levels, got more")
    extension = partial(_from_extension, limit=limit, depth=depth + 1)
    return msgpack.unpackb(data, ext_hook=extension, strict_map_key=True)


def _check_depth(value: object, depth: int) -> None:
    """Raise `BadMessage` for too many levels. Visits every path, which is quick because no object occurs in two places."""
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


def _from_extension(code: int, data: bytes, limit: KeyLimit, depth: int) -> Any:
    match code, data if code in _NOT_MSGPACK else _unpack(data, limit, depth):
        case _Code.TUPLE, list(items):
            return tuple(items)
        case _Code.PAIRS, [list(keys), list(values)]:
            if _too_slow(keys, limit):
                raise BadMessage(f"plain value: got dicts with {TOO_SLOW}")
            return dict(zip(keys, values, strict=True))
        case _Code.ARRAY, [str(dtype), list(shape), bytes(raw)]:
            return _array(_dtype(dtype), shape, raw)
        case _Code.SCALAR, [str(dtype), bytes(raw)]:
            kind = _dtype(dtype)
            if kind.itemsize and len(raw) != kind.itemsize:  # numpy gives an empty text a byte or more
                raise BadMessage(f"scalar {dtype}: expected {kind.itemsize} bytes, got {len(raw)}")
            _check_characters(raw, kind)
            scalar = np.frombuffer(raw, kind)[0] if kind.itemsize else kind.type()
            _check_dates(scalar)
            return scalar
        case _Code.OBJECTS, [list(shape), list(values)]:
            if len(values) != _elements(shape):
                raise BadMessage(f"array of objects of shape {shape}: got {len(values)} objects")
            return np.fromiter(values, object, len(values)).reshape(shape)  # `array[:] = values` would open inner lists
        case _Code.COMPLEX, [float() | int() as real, float() | int() as imaginary]:
            return complex(real, imaginary)
        case _Code.INT, bytes(digits):
            return int(digits)
        case _Code.REPR, bytes(text):
            return ReprString(text.decode())
        case _:
            raise BadMessage(f"plain value: expected a known extension with its kind of payload, got extension {code}")


def _array(kind: np.dtype[Any], shape: list[Any], raw: bytes) -> Any:
    if not kind.itemsize:  # numpy would allocate a byte for each element
        raise BadMessage(f"array {kind.str}: expected elements of a byte or more")
    if len(raw) != _elements(shape) * kind.itemsize:
        raise BadMessage(f"array {kind.str} of shape {shape}: got {len(raw)} bytes")
    _check_characters(raw, kind)
    array = np.frombuffer(raw, kind).reshape(shape).copy() if raw else np.zeros(shape, kind)
    _check_dates(array)
    return array


def _elements(shape: list[Any]) -> int:
    """The number of elements of an array with this shape.

    The dimensions are checked before they are multiplied, because a product of other objects could be of any size.
    """
    if len(shape) > MAX_DIMENSIONS or not all(type(size) is int and 0 <= size <= MAX_SIZE for size in shape):
        raise BadMessage(f"array shape: expected at most {MAX_DIMENSIONS} whole numbers from 0 to {MAX_SIZE}")
    return math.prod(shape)


def _dtype(name: str) -> np.dtype[Any]:
    kind = np.dtype(name) if len(name) <= MAX_DTYPE else None
    if kind is None or kind.kind not in DTYPE_KINDS:
        raise BadMessage(f"array dtype: expected one for plain data, got {name[:20]!r}")
    return kind


def _check_characters(raw: bytes, kind: np.dtype[Any]) -> None:
    """Raise `BadMessage` for invalid characters, because numpy accepts any four bytes, and fails when the text is used."""
    if kind.kind == "U" and raw and (last := int(np.frombuffer(raw, f"{kind.str[0]}u4").max())) > sys.maxunicode:
        raise BadMessage(f"text of {kind.str}: expected characters up to {sys.maxunicode}, got {last}")


def _can_be_shown(value: Any) -> bool:
    """Whether numpy can show this array or scalar. It can't show a date without a unit, except NaT in its own byte order."""
    if value.dtype.kind != "M" or np.datetime_data(value.dtype)[0] != "generic":
        return True
    return value.dtype.isnative and bool(np.isnat(value).all())


def _check_dates(value: Any) -> None:
    """Raise `BadMessage` for dates that can't be shown, because whoever shows a key or an info expects no error."""
    if not _can_be_shown(value):
        raise BadMessage("plain value: expected dates with a unit, got a date without a unit")


@dataclass(slots=True)
class _KeyPath:
    """The place of a value in dicts. Its path is computed once, and only if it is needed."""

    around: _KeyPath | None
    key: object
    known: str = ""

    def path(self) -> str:
        """The keys that lead to the place, short and safe to show."""
        if not self.known:
            key = one_line(str(self.key)[:MAX_NAME], MAX_NAME)
            self.known = (f"{self.around.path()}.{key}" if self.around else key)[:MAX_LINE]
        return self.known


def repr_paths(value: object, most: int) -> list[str]:
    """The first paths inside the value that lead to a `ReprString`: at most this number, short and safe to show."""
    paths: dict[str, None] = {}
    _add_repr_paths(value, None, paths, most)
    return list(paths)


def _add_repr_paths(value: object, place: _KeyPath | None, paths: dict[str, None], most: int) -> None:
    if len(paths) == most:
        return
    match value:
        case ReprString():
            paths[place.path() if place else ""] = None
        case dict():
            for key, inner in value.items():
                if isinstance(inner, _MAY_HAVE_PATHS):
                    _add_repr_paths(inner, _KeyPath(place, key), paths, most)
        case list() | tuple():
            for inner in value:
                if isinstance(inner, _MAY_HAVE_PATHS):
                    _add_repr_paths(inner, place, paths, most)
        case np.ndarray() if value.dtype.kind == "O":
            _add_repr_paths(value.ravel().tolist(), place, paths, most)
        case _:
            pass


_MAY_HAVE_PATHS = (ReprString, dict, list, tuple, np.ndarray)
