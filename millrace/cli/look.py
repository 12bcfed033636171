"""`millrace list`, `dashboard`, `plot` and `report`: runs in a table, in a browser, in a picture, or on one HTML page."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

from learner.report import learning_curves
from learner.report.page import write_page
from learner.report.run_lines import RunLine, algorithm_label, find_runs, read_line
from millrace.cli.flags import DashboardFlags, ListFlags, PlotFlags, ReportFlags
from millrace.cli.status import table
from millrace.dashboard.known_runs import KnownRuns
from millrace.dashboard.live import Lookout
from millrace.dashboard.server import DashboardServer
from millrace.dashboard.site import Site
from protocol.address import is_local
from protocol.errors import UsageError
from protocol.flags.parse import parse_flags


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
        "env steps": f"{line.env_steps:,.0f}",
        "done": f"{line.progress:.0%}",
        "steps/s": f"{line.steps_per_s:,.0f}",
        "started": line.started,
    }


def dashboard(argv: list[str]) -> int:
    """Serve the dashboard until Ctrl-C. Its address is printed first."""
    flags = parse_flags(DashboardFlags, argv, "dashboard")
    folders = flags.folders or (Path("runs"),)
    host, port = where_to_listen(flags.bind, insecure=flags.insecure)
    for folder in flags.folders:
        find_runs([folder])  # a name that is misspelt is an error; the folder `runs` may not be there yet

    def listening(address: str) -> None:
        print(f"dashboard of {', '.join(map(str, folders))}: {address}", flush=True)

    with Lookout() as lookout:
        site = Site(KnownRuns(folders, time.time), lookout.look)
        asyncio.run(DashboardServer(site.answer).serve(host, port, listening))
    return 0


def where_to_listen(bind: str, *, insecure: bool) -> tuple[str, int]:
    """Host and port. Raises `UsageError` for an address that others reach, unless that is asked for."""
    host, _, port = bind.rpartition(":")
    if not (host and port.isascii() and port.isdecimal() and int(port) < 65_536):
        raise UsageError(f"dashboard: bind {bind}: expected HOST:PORT, as in 127.0.0.1:8080")
    if not (insecure or is_local(f"tcp://{bind}")):
        raise UsageError(
            f"dashboard: bind {bind}: others reach this address, and who learns the page's address sees settings, logs and "
            "films of these runs, unencrypted; use an ssh tunnel (ssh -L), or add --insecure"
        )
    return host, int(port)


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
