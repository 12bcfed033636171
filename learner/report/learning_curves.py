"""Learning curves as a PNG, from the metrics.jsonl of run folders. No global state: matplotlib's pyplot stays out.

One panel for each environment, one colour for each algorithm. Seeds of the same (environment, algorithm) are put on a common
grid: a thin line each, their mean, and a band from the worst to the best. Mean and band stop where the shortest run stops,
so that no seed is continued by guessing.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from learner.run_folder.atomic_write import write_atomically
from learner.run_folder.episode_window import WINDOW_EPISODES
from learner.run_folder.metrics_log import read_rows
from learner.run_folder.progress import ENV_STEPS_KEY, RETURN_KEY
from learner.run_folder.run_format import check_format
from protocol.arrays import Doubles
from protocol.errors import RunError, UsageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POINTS = 400
PANEL_INCHES = (6.4, 4.2)
COLUMNS = 3
DPI = 150
COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#000000",
)  # Okabe and Ito: safe for the colour-blind
GREY = "#555555"


class Curve(NamedTuple):
    """One run."""

    env: str
    algo: str
    seed: int
    env_steps: Doubles  # [K] rising
    returns: Doubles  # [K]


def read_curve(run: Path) -> Curve:
    """The learning curve of a run folder. Raises `UsageError` in one line."""
    check_format(run)
    try:
        config = tomllib.loads((run / "config.toml").read_text())
        rows = read_rows(run / "metrics.jsonl")
        env, algo, seed = str(config["env"]), str(config["algo"]), int(config["seed"])
    except FileNotFoundError as error:
        what = f"no {Path(error.filename).name}" if run.is_dir() else "no such folder"
        raise UsageError(f"run {run}: expected a run folder to plot, got {what}") from error
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"run {run} cannot be plotted: {error}") from error
    points = [(row[ENV_STEPS_KEY], row[RETURN_KEY]) for row in rows if row.get(RETURN_KEY) is not None]
    if not points:
        raise UsageError(f"run {run}: nothing to plot, no episode has ended yet")
    env_steps, returns = np.asarray(points, np.float64).T
    return Curve(env, algo, seed, env_steps, returns)


def plot(runs: Sequence[Path], out: Path) -> Path:
    """Draw the runs into `out`. Raises `UsageError` for a folder that cannot be read, `RunError` if `out` is not written."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    curves = [read_curve(run) for run in runs]
    envs, algos = sorted({curve.env for curve in curves}), sorted({curve.algo for curve in curves})
    columns = min(len(envs), COLUMNS)
    rows = math.ceil(len(envs) / columns)
    figure = Figure(
        figsize=(PANEL_INCHES[0] * columns, PANEL_INCHES[1] * rows), layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1)
    )
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[len(envs) :]:
        panel.set_axis_off()
    for env, panel in zip(envs, panels, strict=False):
        for algo, colour in zip(algos, COLOURS * math.ceil(len(algos) / len(COLOURS)), strict=False):
            if group := [curve for curve in curves if (curve.env, curve.algo) == (env, algo)]:
                _draw(panel, group, colour)
        _dress(panel, env)
    try:
        write_atomically(out, lambda file: figure.savefig(file, format="png", dpi=DPI))
    except OSError as error:
        raise RunError(f"{out} not written: {error.strerror}") from error
    return out


def common_grid(curves: Sequence[Curve]) -> tuple[Doubles, Doubles]:
    """Env steps [G] that all curves cover, and their returns [curves, G] there, by linear interpolation."""
    first, last = max(curve.env_steps[0] for curve in curves), min(curve.env_steps[-1] for curve in curves)
    grid = np.linspace(first, last, POINTS) if last > first else np.zeros(0)
    return grid, np.stack([np.interp(grid, curve.env_steps, curve.returns) for curve in curves])


def _draw(panel: Axes, group: Sequence[Curve], colour: str) -> None:
    algo = group[0].algo.upper()
    if len(group) == 1:
        (only,) = group
        panel.plot(only.env_steps, only.returns, color=colour, linewidth=1.8, label=f"{algo}, seed {only.seed}")
        return
    for curve in group:
        panel.plot(curve.env_steps, curve.returns, color=colour, linewidth=0.6, alpha=0.35)
    kind = "seed" if len({curve.seed for curve in group}) == len(group) else "run"
    grid, returns = common_grid(group)
    panel.fill_between(
        grid, returns.min(0), returns.max(0), color=colour, alpha=0.15, linewidth=0, label=f"{algo}, worst to best {kind}"
    )
    panel.plot(grid, returns.mean(0), color=colour, linewidth=2.0, label=f"{algo}, mean of {len(group)} {kind}s")


def _dress(panel: Axes, env: str) -> None:
    from matplotlib.ticker import EngFormatter, MaxNLocator

    panel.set_title(env, fontsize=12, fontweight="bold", loc="left")
    panel.set_xlabel("env steps", fontsize=10, color=GREY)
    panel.set_ylabel(f"return, mean of the last {WINDOW_EPISODES} episodes", fontsize=10, color=GREY)
    panel.xaxis.set_major_formatter(EngFormatter(sep=""))
    panel.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    panel.set_xlim(left=0)
    panel.margins(x=0.01)
    panel.grid(color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=9, colors=GREY, length=3)
    for side, spine in panel.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#bbbbbb")
    handles, labels = panel.get_legend_handles_labels()
    panel.legend(handles[::-1], labels[::-1], loc="best", fontsize=9, frameon=False, labelcolor="#333333")
