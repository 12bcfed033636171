"""Starts a dashboard alongside a program or a run, in a process of its own, so that neither has to wait for it."""

from __future__ import annotations

import logging
import os
import select
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from pathlib import Path
from types import TracebackType
from typing import Self

from millrace.protocol.errors import RunError
from millrace.protocol.logs.notices import log_notice
from millrace.terminal import in_notebook

START_WITHIN_S = 60.0
NOTEBOOK_PIXELS = 640

log = logging.getLogger("millrace.learner")


class Dashboard:
    """Shows runs in a browser, until it is closed or this program ends. A notebook shows the page in the cell.

    `address` is the page's address on this machine. Anyone who knows it can see everything in these runs. Raises `RunError`
    if the dashboard doesn't start.

    >>> from millrace.extras.monitoring.dashboard import Dashboard
    >>> with Dashboard("runs") as dashboard:
    ...     address = dashboard.address
    """

    def __init__(self, *runs: str | os.PathLike[str]) -> None:
        """`runs`: run folders, or folders that contain run folders; by default, the folder `runs`."""
        folders = [os.fspath(run) for run in runs or ("runs",)]
        command = [sys.executable, "-P", "-m", "millrace.extras.monitoring.dashboard.serve", *folders]
        pipe = subprocess.PIPE
        # The process must import millrace from the same place as this program, which may be a clone that isn't installed.
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        # In its own session, the process doesn't get the terminal's Ctrl-C, so that open pages can show how the run ended.
        self._process = subprocess.Popen(
            command,
            env={**os.environ, "PYTHONPATH": path},
            stdin=pipe,
            stdout=pipe,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        assert self._process.stdout is not None
        said, _, _ = select.select([self._process.stdout], [], [], START_WITHIN_S)
        self.address = self._process.stdout.readline().decode().strip() if said else ""
        if not self.address.startswith("http://"):
            self.close()
            raise RunError(f"dashboard: it did not start: {self.address or 'it printed nothing'}")

    def close(self) -> None:
        """End the dashboard at once."""
        self._process.kill()
        self._process.communicate()

    def let_end(self) -> None:
        """Let the dashboard end a short while after this call, so that open pages can show how the run ended."""
        threading.Thread(target=self._process.communicate, name="dashboard-ends", daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _repr_html_(self) -> str:
        address = escape(self.address)
        frame = f'<iframe src="{address}" width="100%" height="{NOTEBOOK_PIXELS}" style="border:0"></iframe>'
        return f'<p><a href="{address}" target="_blank" rel="noreferrer">{address}</a></p>{frame}'

    def __repr__(self) -> str:
        return f"Dashboard({self.address})"


@contextmanager
def page_of_run(run: Path) -> Iterator[None]:
    """A context manager that serves the page of a run and logs its address. If it can't be served, the run continues."""
    page = _started(run)
    try:
        if page is not None:
            _show(page)
        yield
    finally:
        if page is not None:
            page.let_end()


def _started(run: Path) -> Dashboard | None:
    try:
        return Dashboard(run)
    except (RunError, OSError) as error:
        log.warning("%s", error)
        return None


def _show(page: Dashboard) -> None:
    if in_notebook():
        from IPython.display import display

        display(page)
    else:
        log_notice(log, f"page of this run: {page.address}", kept=False)
