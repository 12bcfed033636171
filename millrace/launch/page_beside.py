"""A dashboard beside a program or a run: served by a process of its own, so that it takes no time of the program."""

from __future__ import annotations

import logging
import os
import select
import subprocess
import sys
import threading
from contextlib import ExitStack
from html import escape
from pathlib import Path
from types import TracebackType
from typing import Self

from millrace.learner.config.config import Config
from millrace.learner.resume_checks import Resumption
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_setup import run_folder
from millrace.protocol.errors import RunError
from millrace.protocol.logs.notices import log_notice
from millrace.terminal import in_notebook

START_WITHIN_S = 60.0
NOTEBOOK_PIXELS = 640

log = logging.getLogger("millrace.learner")


class Dashboard:
    """Runs in a browser, until it is closed or this program ends. A notebook shows it in the cell.

    Its `address` is one of this machine; whoever has it sees all that is in these runs. Raises `RunError` if it does not
    start.

    >>> import millrace
    >>> with millrace.Dashboard("runs") as dashboard:
    ...     address = dashboard.address
    """

    def __init__(self, *runs: str | os.PathLike[str]) -> None:
        """`runs`: run folders, or folders of them; if none is given, the folder runs."""
        command = [sys.executable, "-P", "-m", "millrace.dashboard.serve", *(os.fspath(run) for run in runs or ("runs",))]
        pipe = subprocess.PIPE
        # Only this program gets the Ctrl-C of the terminal, so that open pages show how the run ended.
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, start_new_session=True)
        assert self._process.stdout is not None
        said, _, _ = select.select([self._process.stdout], [], [], START_WITHIN_S)
        self.address = self._process.stdout.readline().decode().strip() if said else ""
        if not self.address.startswith("http://"):
            self.close()
            raise RunError(f"dashboard: it did not start: {self.address or 'it said nothing'}")

    def close(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.communicate()

    def let_end(self) -> None:
        """Let it end a short while after this call: pages that are open show how a run has ended."""
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


def opened_folder(config: Config, resume: Resumption | None, stack: ExitStack) -> RunFolder:
    """A new run folder, or the folder of the run to `resume`, locked until the stack ends; with a page if `config` says so.

    Raises `UsageError`.
    """
    folder = stack.enter_context(run_folder(config, resume))
    if config.dashboard:
        _show_page(folder.path, stack)
    return folder


def _show_page(run: Path, stack: ExitStack) -> None:
    """Serve the page of a run until the stack ends, and say where. A run goes on without it if it does not start."""
    try:
        page = Dashboard(run)
    except (RunError, OSError) as error:
        log.warning("%s", error)
        return
    stack.callback(page.let_end)
    if in_notebook():
        from IPython.display import display

        display(page)
    else:
        log_notice(log, f"page of this run: {page.address}", kept=False)
