"""`millrace plot` and `millrace report`: show runs in a picture, or on one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from millrace.extras.monitoring.report.page import write_page
from millrace.extras.monitoring.report.picture import draw
from millrace.flags.fields import Flag
from millrace.flags.parse import parse_flags
from millrace.protocol.errors import UsageError


class PlotFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Draw a report's learning curves: a panel for each environment, a color for each group, a band over seeds."""

    runs: Annotated[tuple[Path, ...], Flag("RUN ...", positional=True)]
    """run folders"""
    out: Annotated[Path | None, Flag("PATH")] = None
    """file to write, as SVG or PNG (pip install pillow resvg_py); if not given, curves.svg in the first run folder"""


class ReportFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Compare runs on one HTML page: results, learning curves, settings, tickets, where the time went, videos."""

    runs: Annotated[tuple[Path, ...], Flag("RUN ...", positional=True)]
    """run folders"""
    out: Annotated[Path | None, Flag("PATH")] = None
    """file to write; if not given, report.html in the first run folder"""


def plot(argv: list[str]) -> int:
    """Draw learning curves, and print the file's path. Returns the exit code."""
    flags = parse_flags(PlotFlags, argv, "plot")
    first = _first(flags.runs, "plot")
    print(draw(flags.runs).save(flags.out or first / "curves.svg"))
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
