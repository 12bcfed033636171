"""Data for a report or a plot, read from a run folder: its configuration, its metrics and learning curve. Reads files."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from learner.config.presets import environment_name
from learner.run_folder.metrics_log import METRICS_FILE, read_rows
from learner.run_folder.progress import ENV_STEPS_KEY, RETURN_KEY
from learner.run_folder.run_format import check_format, check_whole
from protocol.arrays import Doubles
from protocol.errors import UsageError

GRID_POINTS = 400

Purpose = Literal["plot", "report on"]
"""What a run folder is read for; error messages say so."""


class Curve(NamedTuple):
    """The learning curve of one run."""

    env: str
    algo: str
    seed: int
    env_steps: Doubles  # [K] rising
    returns: Doubles  # [K] mean return of the last 100 training episodes


class RunFiles(NamedTuple):
    """The configuration (config.toml) and the rows of metrics of one run folder."""

    env: str
    """The environment's name: with keyword arguments that its preset does not set, it is another environment."""
    algo: str
    seed: int
    config: dict[str, Any]
    workers_elsewhere: bool
    """Whether its workers were started elsewhere: then the setting `workers` means nothing."""
    rows: list[dict[str, Any]]

    def points(self, key: str) -> list[tuple[float, float]]:
        """Env steps and value of this metric, for each row that has it."""
        return [(row[ENV_STEPS_KEY], row[key]) for row in self.rows if row.get(key) is not None]

    def curve(self) -> Curve | None:
        """The learning curve, or None before the first episode has ended."""
        points = self.points(RETURN_KEY)
        return Curve(self.env, self.algo, self.seed, *np.asarray(points, np.float64).T) if points else None


def algorithm_label(algo: str) -> str:
    """The name of an algorithm in a legend: PPO, or the class of one of the user's own."""
    _, own, name = algo.rpartition(":")
    return name if own else algo.upper()


def read_run_files(run: Path, purpose: Purpose) -> RunFiles:
    """Read a run folder. Raises `UsageError`, with a one-line message that names `purpose`, if it cannot be read."""
    elsewhere = check_format(run).workers_elsewhere
    try:
        text = (run / "config.toml").read_text("utf-8")
        check_whole(text, str(run / "config.toml"))
        config = tomllib.loads(text)
        algo, seed = str(config["algo"]), int(config["seed"])
        env = environment_name(str(config["env"]), dict(config.get("env_kwargs", {})), algo)
        return RunFiles(env, algo, seed, config, elsewhere, read_rows(run / METRICS_FILE))
    except FileNotFoundError as error:
        missing = f"no {Path(error.filename).name}" if run.is_dir() else "no such folder"
        raise UsageError(f"run {run}: expected a run folder to {purpose}, got {missing}") from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError, msgspec.MsgspecError) as error:
        raise UsageError(f"run {run}: it is damaged, there is nothing to {purpose}: {error}") from error


def common_grid(curves: Sequence[Curve]) -> tuple[Doubles, Doubles]:
    """Put curves on common env steps by linear interpolation.

    Returns the env steps [G], which all curves cover, and the returns [curves, G]. Mean and band over them end where the
    shortest curve ends, so that no curve is extrapolated.
    """
    first, last = max(curve.env_steps[0] for curve in curves), min(curve.env_steps[-1] for curve in curves)
    grid = np.linspace(first, last, GRID_POINTS) if last > first else np.zeros(0)
    return grid, np.stack([np.interp(grid, curve.env_steps, curve.returns) for curve in curves])
