"""Serves the dashboard.

`python -m millrace.extras.monitoring.dashboard.serve RUNS ...` serves a dashboard for the program that started it, until
that program ends or closes this program's standard input. It prints the address of the first page, or why there is none.
"""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from pathlib import Path

from millrace.extras.monitoring.dashboard.known_runs import KnownRuns
from millrace.extras.monitoring.dashboard.lookout import Lookout
from millrace.extras.monitoring.dashboard.server import DashboardServer
from millrace.extras.monitoring.dashboard.site import Site
from millrace.learner.interrupts import Interrupts, Stopped
from millrace.protocol.errors import UserFacingError

LOOK_FOR_SIGNALS_S = 0.1
LINGER_S = 2.5  # how long the dashboard stays after the run, so that open pages can show how it ended


def serve(folders: Sequence[Path], host: str, port: int, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C. `listening` is called with the address of the first page. Raises `UsageError` if it can't listen.

    This gives the process the lowest priority, so that it doesn't slow training on this machine.
    """
    os.nice(19)
    with Lookout() as lookout, Interrupts() as interrupts:
        site = Site(KnownRuns(folders, time.time), lookout.look)
        asyncio.run(_until_stopped(DashboardServer(site.answer).serve(host, port, listening), interrupts))
    if interrupts.received:
        raise Stopped


async def _until_stopped(serving: Coroutine[None, None, None], interrupts: Interrupts) -> None:
    """Serve until a signal arrives.

    Signals are polled, because an exception in a signal handler would interrupt any code that runs at that moment.
    """
    task = asyncio.ensure_future(serving)
    while not interrupts.received and not task.done():
        await asyncio.wait([task], timeout=LOOK_FOR_SIGNALS_S)
    if not task.done():
        task.cancel()
    with suppress(asyncio.CancelledError):
        await task


def _end_with_input() -> None:
    sys.stdin.buffer.read()
    time.sleep(LINGER_S)
    os._exit(0)  # at once, because there is nothing to save


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    """Serve on a free port of this machine, for the program that started this one."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    try:
        serve([Path(folder) for folder in sys.argv[1:]], "127.0.0.1", 0, _say)
    except UserFacingError as error:
        _say(str(error))


if __name__ == "__main__":
    main()
