"""Checks the calls in a checkpoint's pickle before torch's loader makes them. Pure.

Rule: a pickle may contain only what torch.save writes for tensors and plain data. torch's loader for untrusted files
(`weights_only`) doesn't run code from them, but a few bytes could make it fill the memory: it calls `bytearray` with any
length, and copies a container or a string as often as the file says. It also hashes the keys of dicts. This could take
forever if each tuple in a deep nest contains the next tuple twice, or if each of many numbers in a dict collides with all
others. With lists nested like these tuples, any code that visits them could take as long. This module interprets the pickle
without creating its objects.
"""

from __future__ import annotations

import pickletools
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

from millrace.protocol.bounds import MOST_OTHER_KEYS
from millrace.protocol.key_limit import KeyLimit

VALUES = {"NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "BINUNICODE"}
CONTAINERS = {"EMPTY_LIST", "EMPTY_DICT"}
TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
"""Opcodes that create values, by their names in pickletools. torch.save writes protocol 2."""

REBUILD = {f"torch._utils {name}" for name in ("_rebuild_tensor_v2", "_rebuild_tensor_v3", "_rebuild_parameter")}
"""Functions that create a view of a storage. torch then checks the size of the view."""
ORDERED = "collections OrderedDict"  # the empty dict of a tensor's hooks; also the dict that a module's `state_dict` returns
BYTES = "_codecs encode"  # creates a bytes object, whose content the pickle holds as text
CALLED = REBUILD | {ORDERED, BYTES}
MOST_KEY = 1 << 60  # limit on the size of a number that is a key; larger numbers may all have the same hash
MOST_FULL_DICTS = 10  # dicts with as many numbers as keys as one dict may have
MOST_REPEATED = 1 << 20  # limit on how often a visitor finds an object that it has already found,
REPEATED_PER_BYTE = 16  # plus this number for each byte of the pickle, because many dicts have the same keys
TYPES = ("torch ", "torch.storage ")  # prefixes of the names of storage types and dtypes, which aren't called


STORAGES = {
    "torch.storage UntypedStorage": 1,
    **dict.fromkeys(("torch BoolStorage", "torch ByteStorage", "torch CharStorage"), 1),
    **dict.fromkeys(("torch BFloat16Storage", "torch HalfStorage", "torch ShortStorage"), 2),
    **dict.fromkeys(("torch FloatStorage", "torch IntStorage"), 4),
    **dict.fromkeys(("torch ComplexFloatStorage", "torch DoubleStorage", "torch LongStorage"), 8),
    "torch ComplexDoubleStorage": 16,
}
"""The size of an element, in bytes, by the name of a storage type. torch.save writes tensors of other dtypes untyped."""


class Unfit(Exception):
    """The pickle contains something that isn't allowed. The message says what."""


class _Function(NamedTuple):
    name: str


class _DictKind(Enum):
    """Stands for a dict. An `OrderedDict` may have attributes, which a plain dict contains."""

    PLAIN = auto()
    ORDERED = auto()


@dataclass(slots=True)
class _Made:
    """An object that the loader would create."""

    value: object
    """a number, a text, a function, the kind of a dict, or a tuple of these; None for anything else"""
    values: int = 1
    """the number of objects that a visitor finds in it; an object that occurs several times counts several times"""
    used_again: bool = False
    """whether it occurs a second time. If so, it must be complete, because `values` would otherwise be too small"""
    numbers: int = 0
    """the number of its keys that are numbers"""


def rehearse(content: bytes, storage_bytes: Mapping[str, int]) -> None:
    """Interpret a pickle to its end. Raises `Unfit` for anything that isn't allowed.

    `storage_bytes` has the size of each storage's content in the file, by its key in lower case.
    Damaged bytes raise other exceptions, from `pickletools` or from an empty stack.
    """
    stack = list[_Made]()
    marks = list[int]()
    notes = dict[int, _Made]()
    bytes_left = len(content)
    limit = KeyLimit(MOST_FULL_DICTS)
    values_left = MOST_REPEATED + REPEATED_PER_BYTE * len(content)
    for opcode, argument, _ in pickletools.genops(content):
        match opcode.name, argument:
            case "PROTO" | "STOP", _:
                pass
            case "MARK", _:
                marks.append(len(stack))
            case name, _ if name in VALUES:
                stack.append(_Made(argument))
            case name, _ if name in CONTAINERS:
                stack.append(_Made(_DictKind.PLAIN if name == "EMPTY_DICT" else None))
            case name, _ if name in TUPLES:
                _gather(stack, len(stack) - TUPLES[name])
            case "TUPLE", _:
                _gather(stack, marks.pop())
            case "APPENDS", _:
                _add(stack, marks.pop())
            case "APPEND", _:
                _add(stack, len(stack) - 1)
            case "SETITEMS", _:
                _set_items(stack, marks.pop(), limit)
            case "SETITEM", _:
                _set_items(stack, len(stack) - 2, limit)
            case "BINPUT" | "LONG_BINPUT", int(note) if note <= len(notes):  # others could collide in torch's dict of notes
                notes[note] = stack[-1]
            case "BINGET" | "LONG_BINGET", int(note):
                notes[note].used_again = True
                values_left -= notes[note].values
                if values_left < 0:
                    raise Unfit("it contains the same values too often")
                stack.append(notes[note])
            case "BINPERSID", _:  # a storage, whose content torch reads from elsewhere in the file
                _check_storage(stack[-1].value, storage_bytes)
                stack[-1] = _Made(None)
            case "GLOBAL", str(name) if name in CALLED or name.startswith(TYPES):
                stack.append(_Made(_Function(name)))
            case "REDUCE", _:
                arguments = stack.pop()
                called = stack.pop()
                bytes_left -= _cost(called.value, arguments.value)
                if bytes_left < 0:
                    raise Unfit("it has more bytes objects than fit into the file")
                stack.append(_Made(_DictKind.ORDERED if called.value == _Function(ORDERED) else None))
            case "BUILD", _ if (stack[-2].value, stack[-1].value) == (_DictKind.ORDERED, _DictKind.PLAIN):
                if stack[-1].numbers:  # torch copies them, as often as the file says
                    raise Unfit("expected attributes with names, got a number as a name")
                _add(stack, len(stack) - 1)  # attributes, such as a module's `_metadata`
            case name, _:
                got = str(argument).replace(" ", ".") if name == "GLOBAL" else f"the opcode {name}"
                raise Unfit(f"expected tensors and plain data, got {got}")


def _gather(stack: list[_Made], first: int) -> None:
    """Replace the items on the stack, from index `first` on, with a tuple of these items."""
    items = stack[first:]
    stack[first:] = [_Made(tuple(each.value for each in items), 1 + sum(each.values for each in items))]


def _add(stack: list[_Made], first: int) -> None:
    """Move the items on the stack, from index `first` on, into the list or dict below them."""
    container = stack[first - 1]
    container.values += sum(each.values for each in stack[first:])
    del stack[first:]
    if container.used_again:
        raise Unfit("it has a list or dict that changes after its use")


def _may_be_key(key: object) -> bool:
    return type(key) is str or (type(key) is int and abs(key) < MOST_KEY)


def _set_items(stack: list[_Made], first: int, limit: KeyLimit) -> None:
    """Move keys and values, from index `first` on, into the dict below them. Raises `Unfit` for a key that isn't allowed."""
    keys = [key.value for key in stack[first::2]]
    if not all(map(_may_be_key, keys)):
        raise Unfit("expected tensors and plain data, got a key that is neither text nor a small number")
    filled = stack[first - 1]
    numbers = filled.numbers + sum(type(key) is int for key in keys)
    if not limit.allows(numbers, filled.numbers):
        raise Unfit(f"expected dicts with at most {MOST_OTHER_KEYS:,} numbers as keys, and few such dicts, got more")
    filled.numbers = numbers
    _add(stack, first)


def _check_storage(storage: object, storage_bytes: Mapping[str, int]) -> None:
    """Raise `Unfit` unless this names a storage in the way torch.save does. torch uses the third item as a key.

    The size must be that of the content: until October 2025, torch read the memory behind the content of a larger storage.
    """
    match storage:
        case "storage", _Function(kind), str(key), str(), int(elements) if kind in STORAGES:
            if elements * STORAGES[kind] != storage_bytes.get(key.lower()):
                raise Unfit("expected tensors and plain data, got a storage of another size than its content")
        case _:
            raise Unfit("expected tensors and plain data, got a storage of another form")


def _cost(called: object, arguments: object) -> int:
    """How many bytes a call allocates, apart from tensors. Raises `Unfit` for a call that torch.save does not write."""
    match called, arguments:
        case _Function(name), tuple() if name in REBUILD:
            return 0
        case _Function(name), () if name == ORDERED:
            return 0
        case _Function(name), (str(text), "latin1") if name == BYTES:
            return len(text)
        case _Function(name), _:
            raise Unfit(f"expected tensors and plain data, got a call of {name.replace(' ', '.')}")
        case _:
            raise Unfit("expected tensors and plain data, got a call of something that isn't a function")
