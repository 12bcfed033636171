"""Turns the fields of a record into flags.

Rule: a field becomes a flag of the same name, with dashes instead of underscores. The field's type determines which values
are allowed. `Annotated[..., Flag(...)]` adds what neither name nor type can express. A field that is itself a record isn't a
flag.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]


@dataclass(frozen=True)
class Flag:
    """Properties of a flag, given in its field's annotation."""

    metavar: str = ""
    """placeholder for the values in the help; if empty, it follows from the type"""
    alias: str = ""
    """a second name of the flag"""
    positional: bool = False
    """whether this is a positional argument"""
    hidden: bool = False
    """whether the help leaves it out, because only millrace's own processes pass it to one another"""


class FlagField(NamedTuple):
    """A field of a record, as a flag."""

    name: str
    hint: Any
    """the field's type, with bounds"""
    kind: Any
    """the field's type, without bounds and without None"""
    optional: bool
    """whether the value may be None, which is written as `none`"""
    flag: Flag

    @property
    def written(self) -> str:
        """The flag's name on the command line; for a positional argument, its placeholder."""
        return self.metavar if self.flag.positional else f"--{self.name.replace('_', '-')}"

    @property
    def many(self) -> bool:
        """Whether several words may follow the flag."""
        return get_origin(self.kind) in (tuple, list, dict)

    @property
    def whole(self) -> bool:
        """Whether the values are whole numbers."""
        return (_plain(get_args(self.kind)[0])[0] if self.many else self.kind) is int

    @property
    def metavar(self) -> str:
        """The placeholder for the values in the help; empty for a flag without values."""
        if self.flag.metavar:
            return self.flag.metavar
        if self.flag.positional:
            return self.name.upper()
        shown = _metavar(self.kind)
        return f"{shown}|none" if self.optional else shown


@cache  # evaluating a record's annotations takes milliseconds
def fields_of(record: type[msgspec.Struct]) -> dict[str, FlagField]:
    """The fields of a record, by name. Fields of base classes come first."""
    found = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        kind, optional = _plain(hint)
        if name in record.__struct_fields__ and not (isinstance(kind, type) and issubclass(kind, msgspec.Struct)):
            marks = getattr(hint, "__metadata__", ())
            flag = next((mark for mark in marks if isinstance(mark, Flag)), Flag())
            found[name] = FlagField(name, hint, kind, optional, flag)
    return found


def is_choice(hint: Any) -> bool:
    """Whether a type is a Literal, with or without None."""
    return get_origin(_plain(hint)[0]) is Literal


def choices(hint: Any) -> list[str]:
    """The values, as text, that a type allows. The type is a Literal, with or without None."""
    kind, optional = _plain(hint)
    return [*map(str, get_args(kind)), *(["none"] if optional else [])]


def _plain(hint: Any) -> tuple[Any, bool]:
    """A type without bounds and None, and whether None is allowed."""
    kind = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    if get_origin(kind) not in (Union, UnionType):
        return kind, False
    options = get_args(kind)
    others = [option for option in options if option is not NoneType]
    plain = _plain(others[0])[0] if len(others) == 1 else kind
    return plain, NoneType in options


def _metavar(kind: Any) -> str:
    names = {bool: "", int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
    if kind in names:
        return names[kind]
    match get_origin(kind):
        case origin if origin is Literal:
            return f"{{{','.join(map(str, get_args(kind)))}}}"
        case origin if origin in (tuple, list):
            return f"{_metavar(_plain(get_args(kind)[0])[0])} ..."
        case origin if origin is dict:
            return "NAME VALUE ..."
    return "VALUE"
