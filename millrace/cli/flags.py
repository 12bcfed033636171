"""The flags of the commands that look at runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from millrace.flags.fields import Flag


class ListFlags(msgspec.Struct, frozen=True, kw_only=True):
    """List runs: state, return, progress and speed of each, the newest first."""

    folders: Annotated[tuple[Path, ...], Flag("[FOLDER ...]", positional=True)] = ()
    """folders of runs, or run folders; if none is given, runs"""


class DashboardFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Show runs in a browser: curves that grow while they train, workers, who waits for whom, what went wrong."""

    folders: Annotated[tuple[Path, ...], Flag("[RUNS ...]", positional=True)] = ()
    """folders of runs, or run folders; if none is given, runs"""
    bind: str = "127.0.0.1:0"
    """where the page is served, as HOST:PORT; port 0 is a free one"""
    insecure: bool = False
    """serve it also at an address that others reach: who learns the page's address sees all that is in these runs"""


class PlotFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Draw the learning curves of a report: a panel for each environment, a color for each group, a band over seeds."""

    runs: Annotated[tuple[Path, ...], Flag("RUN ...", positional=True)]
    """run folders"""
    out: Annotated[Path | None, Flag("PATH")] = None
    """file to write, as SVG or PNG; if not given, curves.png in the first run folder"""


class ReportFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Compare runs on one HTML page: results, learning curves, settings, tickets, where the time went, videos."""

    runs: Annotated[tuple[Path, ...], Flag("RUN ...", positional=True)]
    """run folders"""
    out: Annotated[Path | None, Flag("PATH")] = None
    """file to write; if not given, report.html in the first run folder"""
