"""`millrace list`: prints a line for each run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import msgspec

from millrace.cli.status import table
from millrace.flags.fields import Flag
from millrace.flags.parse import parse_flags
from millrace.learner.run_folder.sentences import per_second, return_in_words
from millrace.learner.run_lines import RunLine, algorithm_label, find_runs, read_line


class ListFlags(msgspec.Struct, frozen=True, kw_only=True):
    """List runs: state, return, progress and speed of each, the newest first."""

    folders: Annotated[tuple[Path, ...], Flag("[FOLDER ...]", positional=True)] = ()
    """folders of runs, or run folders; default: the folder runs"""


def list_runs(argv: list[str]) -> int:
    """Print a line for each run. Returns the exit code."""
    flags = parse_flags(ListFlags, argv, "list")
    rows = [_cells(read_line(run, time.time())) for run in find_runs(flags.folders or (Path("runs"),))]
    print(*table(rows, ("run", "state", "environment", "algorithm", "started"), "no run is here"), sep="\n")
    return 0


def _cells(line: RunLine) -> dict[str, str]:
    progress = line.progress
    return {
        "run": line.name,
        "state": line.state,
        "environment": line.env,
        "algorithm": algorithm_label(line.algo),
        "return": "-" if progress.return_mean is None else return_in_words(progress.return_mean),
        "env steps": f"{progress.env_steps_made:,}" if line.has_numbers else "-",
        "done": line.done,
        "steps/s": per_second(progress.steps_per_s) if line.has_numbers else "-",
        "started": line.started,
    }
