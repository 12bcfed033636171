"""Whether a resumed run may change a setting: each field is declared free, adaptable or fixed. Pure.

Rule: a setting is fixed if another value would change the meaning of the saved weights or of the saved state. `Config` and
the hyperparameter records declare each field as `Free[...]`, `Adaptable[...]` or `Fixed[...]`. A resumed run keeps the
settings in its config.toml, except those that you change; changing a fixed setting is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from functools import cache
from types import NoneType
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import msgspec


class OnResume(Enum):
    """What a resumed run does if a setting gets another value. A member's value is its text in the documentation."""

    FREE = "Another value takes effect at once."
    ADAPTABLE = "Another value takes effect at once. A lane begins new episodes if its number of env copies changes."
    FIXED = "Another value is refused: the weights or the state of the run would not match the new value."


Setting = TypeVar("Setting")
Free = Annotated[Setting, OnResume.FREE]
Adaptable = Annotated[Setting, OnResume.ADAPTABLE]
Fixed = Annotated[Setting, OnResume.FIXED]


class Change(NamedTuple):
    """A setting whose given value differs from the run's value."""

    name: str
    on_resume: OnResume
    run: Any
    """the run's value"""
    given: Any


@cache
def declared(record: type[msgspec.Struct], *, by_type: bool = False) -> dict[str, OnResume]:
    """For each setting of a record, in the order of the fields, what a resumed run does if the setting changes.

    With `by_type`, for user-defined records, fields may be undeclared. If such a field overrides a field of a base class, it
    keeps that field's declaration. Otherwise, a float is free, because it is usually a coefficient. Any other field is
    fixed, because the shape of the weights or of the saved state may depend on it.

    Raises TypeError for a field with no declaration or with several, and NameError for a type that cannot be found.
    """
    hints = get_type_hints(record, include_extras=True)
    return {name: _declaration(record, name, hints[name], by_type) for name in record.__struct_fields__}


def changes(run: msgspec.Struct, given: msgspec.Struct) -> Iterator[Change]:
    """Yield the settings that differ, in the order of the fields. Both records must have the same type."""
    for name, on_resume in declared(type(run), by_type=True).items():
        before = getattr(run, name)
        now = getattr(given, name)
        if not isinstance(before, msgspec.Struct) and before != now:
            yield Change(name, on_resume, before, now)


def refusal(changed: list[Change]) -> str:
    """One line of text with the fixed settings that were changed, and their values; empty if there are none."""
    fixed = [change for change in changed if change.on_resume is OnResume.FIXED]
    return "; ".join(
        f"{one.name}: expected {_shown(one.run)} as in its config.toml, got {_shown(one.given)}" for one in fixed
    )


def _declaration(record: type[msgspec.Struct], name: str, hint: Any, by_type: bool) -> OnResume:
    marks = [mark for mark in getattr(hint, "__metadata__", ()) if isinstance(mark, OnResume)]
    if by_type and not marks:
        bases = [base for base in record.__mro__[1:] if issubclass(base, msgspec.Struct) and base is not msgspec.Struct]
        overridden = next((base for base in bases if name in base.__struct_fields__), None)
        if overridden is not None:
            return declared(overridden, by_type=True)[name]
        return OnResume.FREE if _is_float(hint) else OnResume.FIXED
    if len(marks) != 1:
        raise TypeError(f"{record.__name__}.{name}: expected one of Free, Adaptable and Fixed, got {len(marks)}")
    return marks[0]


def _is_float(hint: Any) -> bool:
    """Whether a type is `float` or `float | None`, with or without bounds."""
    hint = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    options = [option for option in get_args(hint) if option is not NoneType]
    return hint is float or (bool(options) and all(map(_is_float, options)))


def _shown(value: Any) -> str:
    return "none" if value is None else str(list(value) if isinstance(value, tuple) else value)
