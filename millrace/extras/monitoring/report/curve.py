"""Data for a report or a plot, read from a run folder: the run's configuration, metrics and learning curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from millrace.learner.config.presets import environment_name
from millrace.learner.run_folder.metrics_log import METRICS_FILE, read_rows
from millrace.learner.run_folder.progress import ENV_STEPS_KEY, RETURN_KEY
from millrace.learner.run_folder.regular_files import reason
from millrace.learner.run_folder.results import EVALUATED_AT_KEY
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_folder.run_format import check_format, read_config
from millrace.protocol.arrays import Doubles
from millrace.protocol.errors import UsageError

GRID_POINTS = 400
DRAWN = -1e300, 1e300
SECONDS_KEY = "time/time_elapsed"


class Curve(NamedTuple):
    """The learning curve of one run."""

    seed: int
    env_steps: Doubles  # [K] ascending
    returns: Doubles  # [K] mean return of the last 100 training episodes


class RunRecord(NamedTuple):
    """The configuration (config.toml) and the rows of metrics of one run folder."""

    env: str
    """The environment's name. It includes keyword arguments that the preset doesn't set, because they make it a different
    environment.
    """
    algo: str
    seed: int
    config: dict[str, Any]
    workers_elsewhere: bool
    """Whether the run's workers were started elsewhere. If so, the setting `workers` has no meaning."""
    rows: list[dict[str, Any]]

    def curve(self) -> Curve | None:
        """The learning curve, or None before the first episode has ended."""
        curve_points = points(self.rows, RETURN_KEY)
        return Curve(self.seed, *curve_points.T) if len(curve_points) else None


def evaluated_at(row: Mapping[str, Any]) -> Any:
    """For a row of metrics with an evaluation, the env steps of the evaluated policy."""
    return row.get(EVALUATED_AT_KEY, row[ENV_STEPS_KEY])


def points(rows: Sequence[Mapping[str, Any]], key: str, *, over_time: bool = False) -> Doubles:
    """The values of a metric over env steps: [K, 2] env steps and value, for the K rows that have both.

    `over_time`: seconds of training instead of env steps. Numbers are clipped to ±1e300, so that an axis can extend a little
    beyond them. For an evaluation, env steps are those of the evaluated policy.
    """

    def at(row: Mapping[str, Any]) -> Any:
        if over_time:
            return row.get(SECONDS_KEY)
        return evaluated_at(row) if key.startswith("eval/") else row[ENV_STEPS_KEY]

    drawn = [(at(row), row[key]) for row in rows if row.get(key) is not None]
    return np.asarray([point for point in drawn if point[0] is not None], np.float64).reshape(-1, 2).clip(*DRAWN)


def read_run_files(run: Path, rows: list[dict[str, Any]] | None = None) -> RunRecord:
    """Read a run folder.

    `rows`: the rows of its metrics, if they have already been read. Raises `UsageError`, with a one-line message, if the
    folder can't be read.
    """
    RunFolder.open(run)
    elsewhere = check_format(run).workers_elsewhere
    config = read_config(run)
    env = environment_name(config["env"], config.get("env_kwargs", {}), config["algo"])
    try:
        rows = read_rows(run / METRICS_FILE) if rows is None else rows
    except OSError as error:
        raise UsageError(f"run {run}: {METRICS_FILE} cannot be read: {reason(error)}") from error
    return RunRecord(env, config["algo"], config["seed"], config, elsewhere, rows)


def common_grid(curves: Sequence[Curve]) -> tuple[Doubles, Doubles]:
    """Interpolate curves linearly at common env steps.

    Returns the env steps [G], which all curves cover, and the returns [curves, G]. Both end where the shortest curve ends,
    so no curve is extrapolated.
    """
    first = max(curve.env_steps[0] for curve in curves)
    last = min(curve.env_steps[-1] for curve in curves)
    grid = np.linspace(first, last, GRID_POINTS) if last > first else np.zeros(0)
    return grid, np.stack([np.interp(grid, curve.env_steps, curve.returns) for curve in curves])
