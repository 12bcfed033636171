"""Parses a command line: its words become the values of its flags.

Rules: a word that begins with a dash and isn't a number is a flag. Other words are values of the flag before them, up to the
number of values that the flag takes; the rest are positional arguments. A value that begins with a dash is written after an
equals sign: `--name=-x`. If a flag is given twice, the last one counts. A user's mistake is reported in one line.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn, TypeVar

import msgspec

from millrace.flags.fields import FlagField, fields_of
from millrace.flags.help import Group, help_text
from millrace.flags.values import read_words
from millrace.protocol.errors import UsageError, did_you_mean, unexpected_arguments

HELP_FLAGS = ("-h", "--help")
EVERYWHERE = (*HELP_FLAGS, "--debug")  # flags that every command accepts

FlagsT = TypeVar("FlagsT", bound=msgspec.Struct)


class Typed(NamedTuple):
    """A flag as the user typed it, and the words between it and the next flag."""

    flag: str
    """the flag, such as `--net`; empty for the words before the first flag"""
    value: str | None
    """the text after an equals sign, as in `--net=64`; None if there is none"""
    words: list[str]

    @property
    def name(self) -> str:
        """The name of the flag's field."""
        return self.flag.lstrip("-").replace("-", "_")


def parse_flags(record: type[FlagsT], argv: Sequence[str], command: str) -> FlagsT:
    """Parse these words as a record of this type. Raises `UsageError` for wrong flags, or SystemExit(0) after `--help`."""
    fields = fields_of(record)
    if asks_for_help(argv):
        show_help(command, " ".join((record.__doc__ or "").split()), {"flags": (record, list(fields))})
    given = given_values(fields, typed_flags(argv), command)
    required = {field.name for field in msgspec.structs.fields(record) if field.required}
    if missing := [fields[name].written for name in fields if name in required - given.keys()]:
        raise UsageError(f"{command}: missing: {', '.join(missing)}{_more(command)}")
    return record(**given)


def show_help(command: str, about: str, groups: Mapping[str, Group]) -> NoReturn:
    """Print the help and raise SystemExit(0)."""
    sys.stdout.write(help_text(command, about, groups))
    raise SystemExit(0)


def asks_for_help(argv: Sequence[str]) -> bool:
    """Whether the user asks for help."""
    return any(flag in argv for flag in HELP_FLAGS)


def cut_at_dashes(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words before `--`, and the words after it."""
    at = argv.index("--") if "--" in argv else len(argv)
    return list(argv[:at]), list(argv[at + 1 :])


def typed_flags(argv: Sequence[str]) -> list[Typed]:
    """The flags that were typed, in order, including unknown ones. The first entry has the words before the first flag."""
    flags = [Typed("", None, [])]
    for word in argv:
        if word in EVERYWHERE:
            continue
        if is_flag(word):
            flag, sign, value = word.partition("=")
            flags.append(Typed(flag, value if sign else None, []))
        else:
            flags[-1].words.append(word)
    return flags


def first_words(flags: Sequence[Typed], *names: str) -> dict[str, str]:
    """By name, the first value of each of these flags. Flags that weren't typed, or have no value, are left out."""
    words = {}
    for typed in flags:
        if typed.name in names and (typed.value is not None or typed.words):
            words[typed.name] = typed.words[0] if typed.value is None else typed.value
    return words


def given_values(
    fields: Mapping[str, FlagField],
    flags: Sequence[Typed],
    command: str,
    hint: Callable[[str], str] = lambda name: "",
) -> dict[str, Any]:
    """The values that were typed, by field. Raises `UsageError` for unknown flags and wrong values.

    `hint` takes the name of an unknown flag, and returns the end of the error's line.
    """
    given: dict[str, Any] = {}
    arguments: list[str] = []
    for typed in flags:
        if not typed.flag:
            arguments += typed.words
            continue
        field = _field(fields, typed.name)
        if field is None or field.flag.positional:
            raise UsageError(f"{command}: {_unknown(fields, typed, command, hint(typed.name))}")
        if field.kind is bool and not field.optional:
            if typed.value is not None:
                expected = f"expected {field.written} or --no-{field.written[2:]}"
                raise UsageError(f"{command}: {typed.flag}={typed.value}: {expected}")
            given[field.name] = typed.name == field.name
            arguments += typed.words
            continue
        if typed.value is not None:
            values = [typed.value]
            arguments += typed.words
        elif field.many:
            values = typed.words
        else:
            values = typed.words[:1]
            arguments += typed.words[1:]
        if not values and not field.many:
            raise UsageError(f"{command}: expected {field.written} {field.metavar}, got no value{_more(command)}")
        given[field.name] = read_words(field, values)
    return given | _arguments([field for field in fields.values() if field.flag.positional], arguments, command)


def is_flag(word: str) -> bool:
    """Whether a word is a flag rather than a value."""
    try:
        float(word)
    except ValueError:
        return len(word) > 1 and word[0] == "-"
    return False


def _field(fields: Mapping[str, FlagField], name: str) -> FlagField | None:
    """The field of this flag, if there is one. A bool field also has a flag that begins with `no`."""
    for field in fields.values():
        if name in (field.name, field.flag.alias) or (field.kind is bool and name == f"no_{field.name}"):
            return field
    return None


def _arguments(fields: Sequence[FlagField], words: list[str], command: str) -> dict[str, Any]:
    given = {}
    for field in fields:
        if field.many:
            given[field.name] = read_words(field, words)
            words = []
        elif words:
            given[field.name] = read_words(field, words[:1])
            words = words[1:]
    if words:
        one_run = any("RUN" in field.metavar for field in fields)
        raise UsageError(f"{command}: {unexpected_arguments(words, one_run=one_run)}")
    return given


def _unknown(fields: Mapping[str, FlagField], typed: Typed, command: str, hint: str) -> str:
    if typed.name in fields:
        argument = fields[typed.name].metavar
        return f"{argument} has no flag; expected it as in: millrace {command} {argument}"
    known = [field for field in fields.values() if not field.flag.positional]
    names = [field.written[2:] for field in known]
    names += [f"no-{field.written[2:]}" for field in known if field.kind is bool]
    return f"unknown flag {typed.flag}{hint or did_you_mean(typed.flag.lstrip('-'), names, '--')}"


def _more(command: str) -> str:
    return f"; millrace {command} --help tells more"
