"""The run data that callbacks send to other programs: settings, and at most one row of numbers per `every_s` seconds.

Rule: rows with an evaluation and the last row are always sent, including the numbers that callbacks before this one logged.
Missing numbers are left out.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from millrace import Callback, Progress
from millrace.learner.run_folder.results import EVALUATED_AT_KEY
from millrace.protocol.errors import UsageError, refusals_of


class RowFilter:
    """Chooses the rows to send."""

    def __init__(self, every_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._every_s = every_s
        self._clock = clock
        self._sent_s: float | None = None
        self._sent_update = -1
        self._logged_update = -1
        self._logged: dict[str, float | None] = {}  # numbers that callbacks logged for the row of this update

    def due(self, progress: Progress) -> dict[str, float] | None:
        """The row of the last update, if it is time to send one; otherwise None."""
        self._remember_logged(progress)
        now = self._clock()
        if self._sent_s is not None and now - self._sent_s < self._every_s:
            return None
        self._sent_s = now
        return self.last(progress)

    def last(self, progress: Progress) -> dict[str, float] | None:
        """The row of the last update; None if it was already sent."""
        self._remember_logged(progress)
        if progress.updates == self._sent_update or not (progress.metrics or progress.lags):
            return None
        self._sent_update = progress.updates
        return numbers(progress.row({**progress.metrics, **self._logged}))

    def _remember_logged(self, progress: Progress) -> None:
        """Remember the numbers that callbacks logged. The run forgets them once it has written the row to metrics.jsonl,
        perhaps before the row is sent.
        """
        if progress.updates != self._logged_update:
            self._logged_update = progress.updates
            self._logged = {}
        self._logged |= logged(progress)


class RowCallback(Callback):
    """The base of callbacks that send rows to a tool. A subclass for each tool implements `_begin`, `_send` and `_end`.

    An error in the tool ends the run with a one-line message that names the tool.
    """

    def __init__(self, tool: str, every_s: float) -> None:
        """`tool`: the name of the tool's module. `every_s`: minimum number of seconds between two rows."""
        self._tool = tool
        self._rows = RowFilter(every_s)

    def on_start(self, progress: Progress) -> None:
        """Begin a run with the name of the run folder, or continue the existing one. Log the numbers of cloning, if any."""
        with refusals_of(self._tool):
            self._begin(progress)
        self._log(self._rows.last(progress), progress)

    def on_update(self, progress: Progress) -> None:
        """Log the metrics of the update."""
        self._log(self._rows.due(progress), progress)

    def on_evaluation(self, progress: Progress) -> None:
        """Log the evaluation."""
        row = self._rows.last(progress) or {}
        if progress.evaluation is not None:
            row |= numbers({**progress.evaluation.metrics(), **logged(progress)})
            if progress.evaluated.env_steps != progress.env_steps:
                row[EVALUATED_AT_KEY] = progress.evaluated.env_steps
        self._log(row, progress)

    def on_end(self, progress: Progress) -> None:
        """Log the last row, and end the run."""
        with refusals_of(self._tool):
            self._end(progress)

    def _log(self, row: dict[str, float] | None, progress: Progress) -> None:
        if row:
            with refusals_of(self._tool):
                self._send(row, progress)

    def _begin(self, progress: Progress) -> None:
        raise NotImplementedError

    def _end(self, progress: Progress) -> None:
        raise NotImplementedError

    def _send(self, row: dict[str, float], progress: Progress) -> None:
        raise NotImplementedError


def logged(progress: Progress) -> dict[str, float | None]:
    """The numbers that callbacks have logged for the current row."""
    return {} if progress.requests is None else progress.requests.logged()


def numbers(row: dict[str, float | None]) -> dict[str, float]:
    """The numbers of a row that are not missing."""
    return {name: value for name, value in row.items() if value is not None}


def flat_settings(progress: Progress) -> dict[str, Any]:
    """All settings of the run by name. Settings in a table are called env_kwargs.gravity or algorithm.learning_rate."""
    flat: dict[str, Any] = {}
    for name, value in progress.settings.items():
        flat |= {f"{name}.{key}": inner for key, inner in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def run_name(progress: Progress) -> str:
    """The name of the run folder."""
    return Path(progress.run).name


def tool(name: str) -> Any:
    """Import the module of a tool. Raises `UsageError`, with a one-line message, if it isn't installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise UsageError(f"{name} is not installed: pip install {name}") from None
