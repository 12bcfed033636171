"""Flags -> a record, by tyro: its `--help`, and one line of ours for each input that it rejects."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Iterator
from itertools import dropwhile, takewhile
from typing import Annotated, Any, TypeVar, get_args, get_origin

import msgspec
import tyro
from tyro.conf import OmitArgPrefixes, Positional, PositionalMetavarFromFieldName

from protocol.errors import UsageError, did_you_mean, unexpected_arguments

REWORDINGS = {
    r"invalid literal for int\(\) with base 10: ": "expected a whole number, got ",
    r"could not convert string to float: ": "expected a number, got ",
    r"^Error parsing (\S+): ": r"\1: ",
    r"^invalid choice (\S+) for argument '(\S+)'\. Expected one of \((.*)\)$": r"\2: expected one of \3, got \1",
    r"^Missing from millrace [\w ]+: ?(.*) \(required\)$": r"missing: \1",
}
"""Patterns of tyro's messages, and our wording of each."""

Record = TypeVar("Record", bound=msgspec.Struct)


def parse_flags(
    kind: type[Record],
    argv: list[str],
    command: str,
    default: Record | None = None,
    *,
    ignore_unknown: bool = False,
    hint: Callable[[str], str] = lambda setting: "",
) -> Record:
    """The record of type `kind` that these flags describe. `default` holds the values of flags that are not given.

    `hint` gets the name of an unknown setting and returns a text for the error message, or an empty string. Raises
    `UsageError`, with a one-line message, if a flag is not valid, and SystemExit(0) after `--help`.
    """
    rejection = io.StringIO()
    try:
        with contextlib.redirect_stderr(rejection):
            record: Record
            record, unknown = tyro.cli(
                kind,
                args=argv,
                prog=f"millrace {command}",
                default=tyro.MISSING if default is None else default,
                return_unknown_args=True,
                config=(OmitArgPrefixes, PositionalMetavarFromFieldName),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UsageError(
            f"{command}: {_message_in_box(rejection.getvalue())}; millrace {command} --help tells more"
        ) from None
    if unknown and not ignore_unknown:
        flag = next((word for word in unknown if word.startswith("-")), None)
        if flag is None:
            one_run = any(field.name == "run" for field in msgspec.structs.fields(kind))
            raise UsageError(f"{command}: {unexpected_arguments(unknown, one_run=one_run)}")
        name = flag.lstrip("-")
        setting = name.replace("-", "_")
        if setting in {field.name for field in msgspec.structs.fields(kind) if _is_positional(field.type)}:
            argument = setting.upper()
            raise UsageError(f"{command}: {argument} has no flag; expected it as in: millrace {command} {argument}")
        similar = hint(setting) or did_you_mean(name, _flag_names(kind, default), "--")
        raise UsageError(f"{command}: unknown flag {flag}{similar}")
    return record


def _flag_names(kind: type[msgspec.Struct], default: msgspec.Struct | None) -> Iterator[str]:
    """All flags of a record and of the records in it, without the leading dashes."""
    for field in msgspec.structs.fields(kind):
        value = getattr(default, field.name, None)
        if isinstance(value, msgspec.Struct):
            yield from _flag_names(type(value), value)
        else:
            name = field.name.replace("_", "-")
            yield name
            if plain_type(field.type) is bool:
                yield f"no-{name}"


def _is_positional(hint: Any) -> bool:
    """Whether a field of this type is an argument without a flag."""
    return get_origin(hint) is Annotated and bool(set(get_args(hint)) & set(get_args(Positional[str])[1:]))


def plain_type(hint: Any) -> Any:
    """The type of a field without what `Annotated` says about it."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _message_in_box(box: str) -> str:
    """The text that tyro prints in a box between the title and the next horizontal rule, as one line."""
    _title, *lines = [line.strip("│ \t") for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()] or [""]
    message_lines = takewhile(lambda line: not _is_rule(line), dropwhile(_is_rule, lines))
    message = " ".join(" ".join(message_lines).split()).rstrip(".")
    for pattern, wording in REWORDINGS.items():
        message = re.sub(pattern, wording, message)
    return message


def _is_rule(line: str) -> bool:
    """Whether this is a horizontal rule (of plain dashes, if the terminal has no box-drawing characters)."""
    return bool(line) and not line.strip("─-╭╮╰╯")
