"""The help of a command: its usage, a description, and its flags in groups. Pure, except for the width of the terminal."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from millrace.flags.field_texts import field_texts
from millrace.flags.fields import FlagField, fields_of

WIDEST_COLUMNS = 120
TEXT_COLUMN = 26  # column at which the help texts begin
NO_BREAK = "\0"  # stands for a space at which a line must not break

Group = tuple[type[msgspec.Struct] | msgspec.Struct, Sequence[str]]
"""A record class, or a record whose values are shown as defaults; and the names of the fields to show"""


class Entry(NamedTuple):
    """The entry of a field in the help."""

    field: FlagField
    text: str
    default: Any
    """the default value; `msgspec.NODEFAULT` if there is none"""
    layered: bool
    """whether the default may come from a preset or a file; then a bool also has a flag that turns it off"""


def help_text(command: str, about: str, groups: Mapping[str, Group]) -> str:
    """The text of the help. Positional arguments come first, whatever group they are in."""
    width = min(shutil.get_terminal_size().columns, WIDEST_COLUMNS)
    entries = {title: list(_entries(*group)) for title, group in groups.items()}
    arguments = [entry for each in entries.values() for entry in each if entry.field.flag.positional]
    required = [entry for each in entries.values() for entry in each if entry.default is msgspec.NODEFAULT]
    usage = [_heading(entry) for entry in [*arguments, *(entry for entry in required if entry not in arguments)]]
    shown = {title: [one for one in each if not one.field.flag.positional] for title, each in entries.items()}
    usage += ["[flags]"] if any(shown.values()) else []
    lines = [" ".join(["usage: millrace", command, *usage]), "", *textwrap.wrap(about, width)]
    if arguments:
        lines += ["", "arguments:", *(line for entry in arguments for line in _lines(entry, width))]
    for title, flags in shown.items():
        lines += ["", f"{title}:", *(line for entry in flags for line in _lines(entry, width))] if flags else []
    return "\n".join([*lines, "", "--help shows this; --debug shows the traceback of an error.", ""])


def _entries(record: type[msgspec.Struct] | msgspec.Struct, names: Sequence[str]) -> Iterator[Entry]:
    kind = record if isinstance(record, type) else type(record)
    fields = fields_of(kind)
    texts = field_texts(kind)
    defaults = {field.name: field.default for field in msgspec.structs.fields(kind)}
    for name in names:
        if not fields[name].flag.hidden:
            value = defaults[name] if record is kind else getattr(record, name)
            yield Entry(fields[name], texts[name], value, layered=record is not kind)


def _heading(entry: Entry) -> str:
    """The heading of an entry, such as `--steps INT`."""
    field = entry.field
    if field.flag.positional:
        return field.metavar if entry.default is msgspec.NODEFAULT else f"[{field.metavar}]"
    if field.kind is bool and not field.optional:
        return f"{field.written}, --no-{field.written[2:]}" if entry.layered else field.written
    alias = f"--{field.flag.alias.replace('_', '-')}, " if field.flag.alias else ""
    return f"{alias}{field.written} {field.metavar}"


def _lines(entry: Entry, width: int) -> list[str]:
    """The lines of an entry: the heading, and next to it or below it the text with the default."""
    heading = f"  {_heading(entry)}"
    text = f"{entry.text}{_default(entry)}"
    lines = textwrap.wrap(text, width - TEXT_COLUMN, break_long_words=False, break_on_hyphens=False)
    wrapped = [line.replace(NO_BREAK, " ") for line in lines]
    indented = [" " * TEXT_COLUMN + line for line in wrapped]
    if len(heading) > TEXT_COLUMN - 2:
        return [*_folded(heading, width), *indented]
    return [heading.ljust(TEXT_COLUMN) + "".join(wrapped[:1]), *indented[1:]]


def _folded(heading: str, width: int) -> list[str]:
    """The lines of a heading. If it is too wide, for example because of many choices, it is folded after a comma."""
    if len(heading) <= width or "," not in heading[:width]:
        return [heading]
    end = heading.rindex(",", 0, width) + 1
    return [heading[:end], *_folded(f"    {heading[end:]}", width)]


def _default(entry: Entry) -> str:
    match entry.default:
        case None:
            return f" (default:{NO_BREAK}none)" if entry.field.metavar.endswith("none") else ""
        case msgspec.NODEFAULT | "" | () | {}:
            return ""
        case False if not entry.layered:
            return ""
        case tuple() | list():
            return f" (default:{NO_BREAK}{' '.join(map(str, entry.default))})"
    return f" (default:{NO_BREAK}{entry.default})"
