"""The files that identify a run folder: its settings (config.toml) and its format (run.json), written when it is made.

Rules: a folder in the current format or an older one can be evaluated and reported, and resumed if its checkpoints have the
current format too (`checkpoint.py`); one in a newer format is rejected with a one-line error. If you change the format such
that older code can't read it, increase `RUN_FORMAT`. Modules are never imported from a run folder, because it may come from
a stranger.
"""

from __future__ import annotations

import os
import platform
import re
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec

from millrace.learner.run_folder.atomic_write import write_file
from millrace.learner.run_folder.regular_files import read, reason
from millrace.protocol.bounds import INVALID, one_line
from millrace.protocol.errors import UsageError
from millrace.protocol.own_module import refuse_modules_in

RUN_FORMAT = 2
RUN_FILE = "run.json"
CONFIG_FILE = "config.toml"
POLICY_JSON = "policy.json"
POLICY_ARRAYS = {"final": "policy.safetensors", "best": "best.safetensors"}
HEAD = "# Repeat this run: millrace train --config THIS_FILE (it is whole if it ends with # end)\n"
END = "# end\n"
"""The last line of config.toml; `HEAD` is the first. Without it, a file that was cut off could still be valid TOML."""
MOST_CONFIG_BYTES = 1 << 18
MOST_NESTED = 1_000_000
"""Limit on (parts of the keys in all lines) × (parts in one line). For a key such as a.b.c, tomllib stores each prefix, and
the name of the table with it."""
NOT_IN_KEYS = re.compile(
    r"""(?s:\"{3}(?:\\.|[^\\])*?(?:"{3,5}|\\?\Z)|'{3}.*?(?:'{3,5}|\Z))"""
    r"""|"(?:\\.|[^"\\\n])*"?|'[^'\n]*'?|\#[^\n]*|(?<![\w.-])[+-]?\d[\d_]*\.\d[\d_]*(?:[eE][+-]?\d+)?(?=\s*[,\]}\#\n])"""
)
"""Strings, comments and numbers. A string that doesn't end also matches, because tomllib reads nothing that follows it."""


class RunFormat(msgspec.Struct, frozen=True, kw_only=True):
    """The content of run.json."""

    format: int
    millrace: str
    """the version of millrace that wrote the file"""
    workers_elsewhere: bool = False
    """whether the run's workers were started elsewhere; if so, its setting `workers` has no meaning"""
    started_from: str = ""
    """the line about the run from which this run started, as it was printed; empty if it began with random weights"""
    callbacks: tuple[str, ...] = ()
    """the names of the callbacks that a Python program passed as objects when the run was started or last resumed"""


DISTRIBUTIONS = {"millrace": "millrace-rl", "torch": "torch", "gymnasium": "gymnasium", "numpy": "numpy"}
"""The name of the installed distribution of each package, by import name."""


class _Identity(msgspec.Struct):
    """The settings that every config.toml has."""

    env: str
    algo: str
    seed: int
    env_kwargs: dict[str, Any] = {}


@cache
def versions() -> dict[str, str]:
    """The versions of Python and of the installed packages on which results depend, by import name."""
    versions = {"python": platform.python_version()}
    for name, distribution in DISTRIBUTIONS.items():
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(distribution)
    return versions


def write_format(
    folder: Path, *, workers_elsewhere: bool = False, started_from: str = "", callbacks: tuple[str, ...] = ()
) -> None:
    """Write run.json with the current format. Raises `RunError` if that fails."""
    run_format = RunFormat(
        format=RUN_FORMAT,
        millrace=versions().get("millrace", ""),
        workers_elsewhere=workers_elsewhere,
        started_from=started_from,
        callbacks=callbacks,
    )
    content = msgspec.json.encode(run_format)
    write_file(folder / RUN_FILE, lambda file: file.write(content + b"\n"))


def read_config(run: Path) -> dict[str, Any]:
    """The settings in the config.toml of a run folder, not converted. They include env, algo and seed.

    Raises `UsageError` if the file is missing, cannot be read, or names a module in the run folder.
    """
    where = run / CONFIG_FILE
    try:
        table = parse_toml(read(where, MOST_CONFIG_BYTES).decode(), str(where))
        msgspec.convert(table, _Identity)
    except FileNotFoundError:
        raise UsageError(f"run {run}: expected a run folder with a {CONFIG_FILE}, got none") from None
    except UnicodeDecodeError as error:
        raise UsageError(f"{where} cannot be read: it is not text") from error
    except OSError as error:
        raise UsageError(f"{where} cannot be read: {reason(error)}") from error
    except msgspec.ValidationError as error:
        raise UsageError(f"{where} is damaged: {error}; restore it, or start a new run") from error
    refuse_modules_in(run, _texts(table))
    return table


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """The content of a TOML file. Raises `UsageError` if it is not valid, or if it is a config.toml that was cut off."""
    text = text.removeprefix("\ufeff")  # a byte order mark, which some editors write
    if text.startswith(HEAD) and not text.rstrip().endswith(END.strip()):
        raise UsageError(f"{where} is cut off: expected {END.strip()!r} as its last line; restore it, or start a new run")
    parts = [1 + line.count(".") for line in NOT_IN_KEYS.sub("", text).split("\n")]
    if sum(parts) * max(parts) > MOST_NESTED:
        raise UsageError(f"{where} has tables in tables in tables, or very long keys; expected the settings of a run")
    try:
        table = tomllib.loads(text)
        msgspec.json.encode(table)  # raises for a whole number with more digits than Python writes
    except (ValueError, OverflowError, RecursionError) as error:
        raise UsageError(f"{where} is not TOML: {one_line(str(error))}") from error
    return table


def is_run_folder(folder: Path) -> bool:
    """Whether this is a run folder, or has the policy files of one."""

    def has(name: str) -> bool:
        return os.path.lexists(folder / name)

    return (has(CONFIG_FILE) and has(RUN_FILE)) or (has(POLICY_JSON) and any(map(has, POLICY_ARRAYS.values())))


def _texts(value: Any) -> Iterator[str]:
    """Yield every string in nested tables and lists."""
    match value:
        case str():
            yield value
        case list():
            for inner in value:
                yield from _texts(inner)
        case dict():
            for key, inner in value.items():
                yield from (key, *_texts(inner))


def check_format(folder: Path) -> RunFormat:
    """Read a run folder's run.json. Raises `UsageError`, with a one-line message, if this millrace can't read it."""
    try:
        run_format = msgspec.json.decode(read(folder / RUN_FILE), type=RunFormat)
    except FileNotFoundError:
        raise UsageError(f"run {folder}: expected a run folder, got one without {RUN_FILE}") from None
    except (OSError, *INVALID) as error:
        raise UsageError(
            f"run {folder}: {RUN_FILE} cannot be read: {reason(error)}; restore it, or start a new run"
        ) from error
    if run_format.format > RUN_FORMAT:
        raise UsageError(
            f"run {folder}: its format is {run_format.format}, and this millrace reads formats up to {RUN_FORMAT}; "
            f"install the millrace that wrote it ({run_format.millrace or 'unknown version'}) or a newer one"
        )
    return run_format
