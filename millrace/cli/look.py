"""`millrace list`, `plot` and `report`: runs in a table, in a picture, or on one HTML page."""

from __future__ import annotations

import time
from pathlib import Path

from millrace.cli.flags import ListFlags, PlotFlags, ReportFlags
from millrace.cli.status import table
from millrace.flags.parse import parse_flags
from millrace.learner.report.page import write_page
from millrace.learner.report.picture import draw
from millrace.learner.run_folder.sentences import per_second
from millrace.learner.run_lines import RunLine, algorithm_label, find_runs, read_line
from millrace.protocol.errors import UsageError


def list_runs(argv: list[str]) -> int:
    """Print a line for each run. Returns the exit code."""
    flags = parse_flags(ListFlags, argv, "list")
    rows = [_cells(read_line(run, time.time())) for run in find_runs(flags.folders or (Path("runs"),))]
    print(*table(rows, ("run", "state", "environment", "algorithm", "started"), "no run is here"), sep="\n")
    return 0


def _cells(line: RunLine) -> dict[str, str]:
    return {
        "run": line.name,
        "state": line.state,
        "environment": line.env,
        "algorithm": algorithm_label(line.algo),
        "return": "-" if line.return_mean is None else f"{line.return_mean:,.1f}",
        "env steps": "-" if line.begins else f"{line.env_steps:,.0f}",
        "done": line.done,
        "steps/s": "-" if line.begins else per_second(line.steps_per_s),
        "started": line.started,
    }


def plot(argv: list[str]) -> int:
    """Draw learning curves, and print the file's path. Returns the exit code."""
    flags = parse_flags(PlotFlags, argv, "plot")
    first = _first(flags.runs, "plot")
    print(draw(flags.runs).save(flags.out or first / "curves.png"))
    return 0


def report(argv: list[str]) -> int:
    """Write the page, and print its path. Returns the exit code."""
    flags = parse_flags(ReportFlags, argv, "report")
    first = _first(flags.runs, "report")
    print(write_page(flags.runs, flags.out or first / "report.html"))
    return 0


def _first(runs: tuple[Path, ...], command: str) -> Path:
    if not runs:
        raise UsageError(f"{command}: which runs? expected run folders, as in: millrace {command} runs/*")
    return runs[0]
