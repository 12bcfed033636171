"""`millrace plot` and `millrace report`: compare runs in a picture, or on one HTML page."""

from __future__ import annotations

from pathlib import Path

from learner.report import learning_curves
from learner.report.page import write_page
from millrace.cli.flags import PlotFlags, ReportFlags
from protocol.errors import UsageError
from protocol.flags.parse import parse_flags


def plot(argv: list[str]) -> int:
    """Draw learning curves, and print the file's path. Returns the exit code."""
    flags = parse_flags(PlotFlags, argv, "plot")
    first = _first(flags.runs, "plot")
    print(learning_curves.plot(flags.runs, flags.out or first / "curves.png"))
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
