"""Flags to records, by tyro: its `--help`, one line of ours for what it refuses. And a run's own flags: all of `Config`."""

from __future__ import annotations

import contextlib
import functools
import io
import re
from collections.abc import Iterator
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import tyro
from tyro.conf import OmitArgPrefixes, PositionalMetavarFromFieldName

from learner.config.config import Config, checked, lower_layers, over
from learner.config.did_you_mean import nearest
from learner.config.hyperparameters import elsewhere
from learner.run_folder.resume import AUTO, newest_run
from protocol.errors import UsageError

PLAINER = {
    r"invalid literal for int\(\) with base 10: ": "expected a whole number, got ",
    r"could not convert string to float: ": "expected a number, got ",
    r"^Error parsing (\S+): ": r"\1 ",
    r"^invalid choice (\S+) for argument '(\S+)'\. Expected one of \((.*)\)$": r"\2 expected one of \3, got \1",
    r"^Missing from millrace [\w ]+: ?(.*) \(required\)$": r"missing: \1",
}

Record = TypeVar("Record", bound=msgspec.Struct)


class RunFlags(Config, frozen=True, kw_only=True):
    """Train a policy. What is not given here comes from --config, then the preset of the environment, then the defaults."""

    config: Path | None = None
    """a TOML file of settings; a run folder's config.toml repeats that run"""
    preset: str = "auto"
    """a whole run by name (millrace presets lists them), the environment whose preset to take, or none"""
    resume: Path | None = None
    """a run folder to go on with, from its newest checkpoint; auto: the newest of this ENV, algo and seed, or a new one"""
    log_json: bool = False
    """say what happens as JSON, one event a line, on stderr; and nothing else"""
    debug: bool = False
    """show the traceback of an error"""


def configuration(command: str, argv: list[str]) -> tuple[Config, Path | None]:
    """The configuration from all its layers, and the run to resume."""
    config, resume = _layered(command, argv)
    if resume != AUTO:
        return config, resume
    found = newest_run(config)
    return (config, None) if found is None else (_layered(command, argv, found)[0], found)


def _layered(command: str, argv: list[str], found: Path | None = None) -> tuple[Config, Path | None]:
    """The configuration, and what --resume says. `found` is the run that it chose: its settings then lie below the flags.

    Flags are read more than once, because what lies below them depends on them.
    """
    asked = [flag for flag in argv if flag not in ("-h", "--help")]
    first = parse(RunFlags, asked, command, RunFlags(algo=""), lenient=True)
    resume = found if first.resume == AUTO else first.resume
    file = None if found else first.config  # the run's own settings came from it
    below = functools.partial(lower_layers, algo=first.algo or None, file=file, resume=resume, preset=first.preset)
    algorithm = below("").algorithm
    if type(algorithm) is not type(first.algorithm):  # its own flags were not known, and their values looked like ENV
        first = parse(RunFlags, asked, command, RunFlags(algo="", algorithm=algorithm), lenient=True)
    base = below(first.env)
    default = RunFlags(**{**_fields(base), "env_kwargs": {}})
    flags = parse(RunFlags, argv if asked == argv else ["--help"], command, default)
    config = Config(**_fields(flags))
    return checked(over(config, {"env_kwargs": base.env_kwargs | config.env_kwargs}, "")), flags.resume


def _fields(config: Config) -> dict[str, Any]:
    return {name: getattr(config, name) for name in Config.__struct_fields__}


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
        name = flag.lstrip("-")
        other = elsewhere(name.replace("-", "_")) if issubclass(kind, Config) else ""
        raise UsageError(f"{command}: unknown flag {flag}{other or nearest(name, _names(kind, default), '--')}")
    return record


def _names(kind: type[msgspec.Struct], default: msgspec.Struct | None) -> Iterator[str]:
    """Of all flags of a record, those of the records within it too, without the dashes before them."""
    for field in msgspec.structs.fields(kind):
        value = getattr(default, field.name, None)
        if isinstance(value, msgspec.Struct):
            yield from _names(type(value), value)
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
