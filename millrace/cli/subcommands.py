"""Commands with subcommands: finds the subcommand, and prints the help that lists them all."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

import msgspec

from millrace.flags.fields import fields_of
from millrace.flags.parse import HELP_FLAGS
from millrace.protocol.errors import UsageError, did_you_mean

Records = Mapping[str, type[msgspec.Struct]]
"""The flags of each subcommand"""


def chosen_subcommand(command: str, about: str, records: Records, argv: Sequence[str]) -> tuple[str, list[str]]:
    """The subcommand and the words after it. Raises `UsageError`, or SystemExit(0) after `--help`."""
    name, *rest = argv or [""]
    if name in HELP_FLAGS:
        sys.stdout.write(_help(command, about, records))
        raise SystemExit(0)
    if name not in records:
        problem = f" {name}: no such command{did_you_mean(name, records)};" if name else ": which command?"
        raise UsageError(f"{command}{problem} expected one of {', '.join(records)}")
    return name, rest


def _help(command: str, about: str, records: Records) -> str:
    lines = [f"usage: millrace {command} {'|'.join(records)} …", "", about, ""]
    for name, record in records.items():
        arguments = [field.metavar for field in fields_of(record).values() if field.flag.positional]
        lines.append(f"  millrace {command} {' '.join([name, *arguments]):18} {' '.join((record.__doc__ or '').split())}")
    return "\n".join([*lines, "", f"millrace {command} COMMAND --help lists the flags of each.", ""])
