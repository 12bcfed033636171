"""`millrace dashboard`: shows runs in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from millrace.extras.monitoring.dashboard.serve import serve
from millrace.flags.fields import Flag
from millrace.flags.parse import parse_flags
from millrace.learner.run_lines import find_runs
from millrace.protocol.address import is_local
from millrace.protocol.errors import UsageError


class DashboardFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Show runs in a browser: curves that grow during training, workers, who waits for whom, what went wrong."""

    folders: Annotated[tuple[Path, ...], Flag("RUNS ...", positional=True)] = ()
    """folders of runs, or run folders; if none is given, runs"""
    bind: str = "127.0.0.1:0"
    """where the page is served, as HOST:PORT; port 0 means any free port"""
    insecure: bool = False
    """serve the page even where others can reach it: anyone who learns its address sees everything in these runs"""


def dashboard(argv: list[str]) -> int:
    """Print the address of the dashboard, and serve it until Ctrl-C. Returns the exit code."""
    flags = parse_flags(DashboardFlags, argv, "dashboard")
    folders = flags.folders or (Path("runs"),)
    host, port = where_to_listen(flags.bind, insecure=flags.insecure)
    for folder in flags.folders:
        find_runs([folder])  # a misspelled name is an error; the folder `runs` may not exist yet

    def listening(address: str) -> None:
        print(f"dashboard of {', '.join(map(str, folders))}: {address}", flush=True)

    serve(folders, host, port, listening)
    return 0


def where_to_listen(bind: str, *, insecure: bool) -> tuple[str, int]:
    """The host and port in `bind`. Raises `UsageError` for an address that others can reach, unless `insecure`."""
    host, _, port = bind.rpartition(":")
    if not (host and port.isascii() and port.isdecimal() and int(port) < 65_536):
        raise UsageError(f"dashboard: bind {bind}: expected HOST:PORT, as in 127.0.0.1:8080")
    if not (insecure or is_local(f"tcp://{bind}")):
        raise UsageError(
            f"dashboard: bind {bind}: others can reach this address, and anyone who learns the URL sees settings, logs and "
            "videos of these runs, unencrypted; use an ssh tunnel (ssh -L), or add --insecure"
        )
    return host, int(port)
