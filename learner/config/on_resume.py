"""What may become of a setting when a run is resumed: each one is declared free, adaptable or fixed where it stands. Pure.

Rule: a setting that gives the saved weights or the saved state another meaning is fixed. `Config` and the records of
hyperparameters declare each field as `Free[...]`, `Adaptable[...]` or `Fixed[...]`. A resumed run keeps the settings in its
config.toml, except those that are given; a fixed one that is given with another value is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

import msgspec


class OnResume(Enum):
    """How a resumed run takes another value of a setting. The value of a member is its meaning, for the documentation."""

    FREE = "Another value takes effect at once."
    ADAPTABLE = "Another value takes effect at once, and what belongs to single lanes and env copies starts afresh."
    FIXED = "Another value is refused: the weights or the state of the run would mean something else."


Setting = TypeVar("Setting")
Free = Annotated[Setting, OnResume.FREE]
Adaptable = Annotated[Setting, OnResume.ADAPTABLE]
Fixed = Annotated[Setting, OnResume.FIXED]


class Change(NamedTuple):
    """A setting that is given with another value than the run has."""

    name: str
    on_resume: OnResume
    run: Any
    """the run's value"""
    given: Any


def declared(record: type[msgspec.Struct]) -> dict[str, OnResume]:
    """How a resumed run takes each setting of a record, in the order of its fields.

    Raises TypeError for a field that does not declare it exactly once.
    """
    hints = get_type_hints(record, include_extras=True)
    return {name: _declaration(record, name, hints[name]) for name in record.__struct_fields__}


def changes(run: msgspec.Struct, given: msgspec.Struct) -> Iterator[Change]:
    """The settings that differ, in the order of the fields. Both records are of one type."""
    for name, on_resume in declared(type(run)).items():
        before, now = getattr(run, name), getattr(given, name)
        if not isinstance(before, msgspec.Struct) and before != now:
            yield Change(name, on_resume, before, now)


def refusal(changed: list[Change]) -> str:
    """Which of these are fixed, and the values, as text in one line; empty if there is none."""
    fixed = [change for change in changed if change.on_resume is OnResume.FIXED]
    return "; ".join(
        f"{one.name}: expected {_shown(one.run)} as in its config.toml, got {_shown(one.given)}" for one in fixed
    )


def _declaration(record: type[msgspec.Struct], name: str, hint: Any) -> OnResume:
    found = [mark for mark in getattr(hint, "__metadata__", ()) if isinstance(mark, OnResume)]
    if len(found) != 1:
        raise TypeError(f"{record.__name__}.{name}: expected one of Free, Adaptable and Fixed, got {len(found)}")
    return found[0]


def _shown(value: Any) -> str:
    return "none" if value is None else str(list(value) if isinstance(value, tuple) else value)
