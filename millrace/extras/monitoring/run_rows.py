"""What callbacks send of a run to other programs: flattened settings, and a row of numbers every `every_s` seconds at most.

Rule: a row with an evaluation and the last row are always sent, with what callbacks before this one logged for them. Numbers
that are missing are left out.
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
    """Chooses which rows are sent."""

    def __init__(self, every_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._every_s = every_s
        self._clock = clock
        self._sent_s: float | None = None
        self._sent_update = -1
        self._logged_update = -1
        self._logged: dict[str, float | None] = {}  # for the row of this update

    def due(self, progress: Progress) -> dict[str, float] | None:
        """The row of the last update, if it is to be sent now."""
        self._remember_logged(progress)
        now = self._clock()
        if self._sent_s is not None and now - self._sent_s < self._every_s:
            return None
        self._sent_s = now
        return self.last(progress)

    def last(self, progress: Progress) -> dict[str, float] | None:
        """The row of the last update, unless it was sent."""
        self._remember_logged(progress)
        if progress.updates == self._sent_update or not (progress.metrics or progress.lags):
            return None
        self._sent_update = progress.updates
        return numbers(progress.row({**progress.metrics, **self._logged}))

    def _remember_logged(self, progress: Progress) -> None:
        """The run forgets these numbers when it has written the row; here it may not have been sent."""
        if progress.updates != self._logged_update:
            self._logged_update = progress.updates
            self._logged = {}
        self._logged |= logged(progress)


class RowCallback(Callback):
    """Sends rows to a tool. A subclass for each tool says how: `_begin`, `_send`, `_end`.

    What the tool refuses ends the run, in one line that names the tool.
    """

    def __init__(self, tool: str, every_s: float) -> None:
        """`tool`: the module of this tool. `every_s`: least number of seconds between two rows."""
        self._tool = tool
        self._rows = RowFilter(every_s)

    def on_start(self, progress: Progress) -> None:
        """Begin a run with this folder's name, or continue the existing one. Log the numbers of cloning, if any."""
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
    """What callbacks have logged at this moment of the run."""
    return {} if progress.requests is None else progress.requests.logged()


def numbers(row: dict[str, float | None]) -> dict[str, float]:
    """The numbers of a row that are not missing."""
    return {name: value for name, value in row.items() if value is not None}


def flat_settings(progress: Progress) -> dict[str, Any]:
    """All settings of the run by name; those of a table as env_kwargs.gravity or algorithm.learning_rate."""
    flat: dict[str, Any] = {}
    for name, value in progress.settings.items():
        flat |= {f"{name}.{key}": inner for key, inner in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def run_name(progress: Progress) -> str:
    """The name of the run folder."""
    return Path(progress.run).name


def tool(name: str) -> Any:
    """The module of this tool. Raises `UsageError`, in one line, if it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise UsageError(f"{name} is not installed: pip install {name}") from None
