"""Flags to records, by tyro. `--help` is tyro's; what it refuses becomes one line of ours."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import TypeVar

import msgspec
import tyro
from tyro.conf import OmitArgPrefixes, Positional, PositionalMetavarFromFieldName

from learner.nearest import nearest
from protocol.errors import UsageError

PLAINER = {
    r"invalid literal for int\(\) with base 10: ": "expected a whole number, got ",
    r"could not convert string to float: ": "expected a number, got ",
    r"^Error parsing (\S+): ": r"\1 ",
    r"^invalid choice (\S+) for argument '(\S+)'\. Expected one of \((.*)\)$": r"\2 expected one of \3, got \1",
    r"^Missing from millrace \w+: ?(.*) \(required\)$": r"missing: \1",
}

Record = TypeVar("Record", bound=msgspec.Struct)


class EvaluateFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Greedy episodes of a run's newest policy: mean and standard deviation of the return."""

    run: Positional[Path]
    """the run folder"""
    episodes: int = 100
    """how many"""
    seed: int = 1_000_000
    """of the episodes; another seed, other episodes"""
    debug: bool = False
    """show the traceback of an error"""


class PlotFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Learning curves as a PNG: a panel for each environment, a colour for each algorithm, seeds as a band."""

    runs: Positional[tuple[Path, ...]]
    """run folders"""
    out: Path | None = None
    """the PNG; curves.png in the first run folder if not given"""
    debug: bool = False
    """show the traceback of an error"""


def parse(kind: type[Record], argv: list[str], command: str, default: Record | None = None, lenient: bool = False) -> Record:
    """A record from flags; `lenient` passes over unknown ones. Raises `UsageError`, or SystemExit(0) after `--help`."""
    refused = io.StringIO()
    try:
        with contextlib.redirect_stderr(refused):
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
        raise UsageError(f"{command}: {_gist(refused.getvalue())}; millrace {command} --help tells more") from None
    if unknown and not lenient:
        flag = next((word for word in unknown if word.startswith("-")), None)
        if flag is None:
            raise UsageError(f"{command}: unexpected argument {unknown[0]}")
        raise UsageError(f"{command}: unknown flag {flag}{nearest(flag.lstrip('-'), _names(kind), '--')}")
    return record


def _names(kind: type[msgspec.Struct]) -> Iterator[str]:
    """Of all flags of a record, those of records within it too, without the dashes before them."""
    for field in msgspec.structs.fields(kind):
        if isinstance(field.type, type) and issubclass(field.type, msgspec.Struct):
            yield from _names(field.type)
        else:
            name = field.name.replace("_", "-")
            yield name
            if field.type is bool:
                yield f"no-{name}"


def _gist(box: str) -> str:
    """What tyro's box (of dashes, where the terminal has nothing better) says between its title and the next rule."""
    _title, *lines = [line.strip("│ \t") for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()] or [""]
    told = takewhile(lambda line: not _is_rule(line), dropwhile(_is_rule, lines))
    gist = " ".join(" ".join(told).split()).rstrip(".")
    for python_says, we_say in PLAINER.items():
        gist = re.sub(python_says, we_say, gist)
    return gist


def _is_rule(line: str) -> bool:
    return bool(line) and not line.strip("─-╭╮╰╯")
