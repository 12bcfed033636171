"""The format version of a run folder: run.json, written when the folder is made.

Rule: a folder of the current format or an older one can be evaluated, reported and resumed; a newer one is rejected in
one line. Format 1 had no run.json. Raise `RUN_FORMAT` when older code could not read a folder of the new one.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from learner.run_folder.atomic_write import write_atomically
from learner.run_folder.versions import versions
from protocol.errors import UsageError

RUN_FORMAT = 2
RUN_FILE = "run.json"
HEAD = "# Repeat this run: millrace train --config THIS_FILE (it is whole if it ends with # end)\n"
END = "# end\n"
"""The first and the last line of config.toml. A file that was cut off may still be TOML, with other settings."""


class RunFormat(msgspec.Struct, frozen=True, kw_only=True):
    """run.json."""

    format: int
    millrace: str
    """the version of millrace that wrote it"""
    workers_elsewhere: bool = False
    """Whether the run's workers were started elsewhere. Its setting `workers` then means nothing."""


def write_format(folder: Path, *, workers_elsewhere: bool = False) -> None:
    """Write run.json with the current format. Raises OSError."""
    version = versions().get("millrace", "")
    content = msgspec.json.encode(RunFormat(format=RUN_FORMAT, millrace=version, workers_elsewhere=workers_elsewhere))
    write_atomically(folder / RUN_FILE, lambda file: file.write(content + b"\n"))


def check_whole(text: str, where: str) -> None:
    """Raise `UsageError` if this config.toml has the first line and not the last."""
    if text.startswith(HEAD) and not text.rstrip().endswith(END.strip()):
        raise UsageError(f"{where} is cut off: expected {END.strip()!r} as its last line; restore it, or start a new run")


def check_format(folder: Path) -> RunFormat:
    """The run.json of a run folder. Raises `UsageError`, with a one-line message, if this millrace cannot read it."""
    try:
        found = msgspec.json.decode((folder / RUN_FILE).read_bytes(), type=RunFormat)
    except (FileNotFoundError, NotADirectoryError):
        return RunFormat(format=1, millrace="")
    except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise UsageError(
            f"run {folder}: {RUN_FILE} cannot be read: {error}; if this millrace wrote the run, delete that file"
        ) from error
    if found.format > RUN_FORMAT:
        raise UsageError(
            f"run {folder}: its format is {found.format}, and this millrace reads formats up to {RUN_FORMAT}; "
            f"install the millrace that wrote it ({found.millrace or 'unknown version'}) or a newer one"
        )
    return found
