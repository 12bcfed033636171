"""The effect of V-trace: A2C and IMPALA on CartPole-v1, with new and old weights (`python -m benchmarks.off_policy`).

Rule: runs differ only in the algorithm, `max_lag` and the seed. With `max_lag` 0 both algorithms compute the same update.
With 8, a rollout's weights may be eight versions old when an update uses it; A2C ignores this, and V-trace corrects for it.
The actual lag of each run is measured. These are whole runs of `millrace.train`. The figure is docs/images/off_policy.png.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import millrace
from benchmarks.writing import COLORS, DPI, GREY, RESULTS, write
from millrace.extras.monitoring.report.curve import Curve, common_grid, read_run_files
from millrace.learner.run_folder.run_folder import RunFolder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PNG = Path(__file__).parents[1] / "docs" / "images" / "off_policy.png"
ALGORITHMS = {"a2c": COLORS[1], "impala": COLORS[0]}
LAGS = (0, 8)
SEEDS = 5
SETTINGS: dict[str, Any] = {
    "steps": 200_000,
    "workers": 4,  # many workers and small batches make the learner the slower side, and rollouts get old
    "envs": 8,
    "lanes": 4,
    "rollout_steps": 16,
    "learning_rate": 1e-2,
    "learning_rate_schedule": "linear",
    "optimizer": "rmsprop",
    "gamma": 0.99,
    "ent_coef": 0.05,
    "normalize_rewards": True,
    "eval_episodes": 100,
}


class Trained(NamedTuple):
    """The result of one run."""

    algo: str
    max_lag: int
    seed: int
    lag_mean: float
    """mean lag of the rollouts that updates used, in versions"""
    return_final: float
    """mean return of the final policy's greedy episodes"""
    wall_s: float
    curve: Curve


def train(algo: str, max_lag: int, seed: int) -> Trained:
    """Run the training and read its results."""
    where = RESULTS / "off_policy" / f"{algo}-lag{max_lag}"
    run = millrace.train(
        "CartPole-v1", preset="none", algo=algo, max_lag=max_lag, seed=seed, run_dir=str(where), **SETTINGS
    ).path
    summary = RunFolder.open(run).summary()
    assert summary is not None
    assert summary.evaluation is not None
    files = read_run_files(run)
    curve = files.curve()
    assert curve is not None
    lag = statistics.fmean(row["lag/mean"] for row in files.rows)
    return Trained(algo, max_lag, seed, lag, summary.evaluation.return_mean, summary.wall_s, curve)


def show(runs: Sequence[Trained]) -> Table:
    """A table with a row for each algorithm and `max_lag`."""
    table = Table(title=f"CartPole-v1 after {SETTINGS['steps']:,} env steps, the same settings everywhere")
    for column in ("", "max lag", "lag measured", "greedy return of each seed", "median", "seconds"):
        table.add_column(column, justify="right" if column in ("max lag", "lag measured", "median", "seconds") else "left")
    for max_lag in LAGS:
        for algo in ALGORITHMS:
            group = [run for run in runs if (run.algo, run.max_lag) == (algo, max_lag)]
            lag = f"{statistics.fmean(run.lag_mean for run in group):.1f}"
            returns = [run.return_final for run in group]
            seconds = f"{statistics.median(run.wall_s for run in group):.0f}"
            seeds = ", ".join(f"{found:.0f}" for found in returns)
            table.add_row(algo.upper(), str(max_lag), lag, seeds, f"{statistics.median(returns):.0f}", seconds)
    return table


def draw(runs: Sequence[Trained], out: Path) -> None:
    """Draw a panel for each `max_lag`, with the median over seeds and a band from the worst to the best seed."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine
    from matplotlib.ticker import EngFormatter, MaxNLocator

    figure = Figure(figsize=(9.6, 4.0), layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1))
    panels = figure.subplots(1, len(LAGS), sharey=True)
    for panel, max_lag in zip(panels, LAGS, strict=True):
        group = [run for run in runs if run.max_lag == max_lag]
        _curves(panel, group)
        lag = statistics.fmean(run.lag_mean for run in group)
        subtitle = "always the newest weights" if max_lag == 0 else f"weights {lag:.1f} versions old on average"
        panel.set_title(f"max_lag {max_lag}: {subtitle}", fontsize=11, fontweight="bold", loc="left")
        panel.set_xlabel("env steps", color=GREY)
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
        panel.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        panel.set_xlim(0, SETTINGS["steps"])
        panel.set_ylim(0, 510)
        panel.grid(color="#dddddd", linewidth=0.6)
        panel.tick_params(labelsize=9, colors=GREY, length=3)
        for side, spine in panel.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color("#bbbbbb")
    panels[0].set_ylabel("return, mean of the last 100 episodes", color=GREY)
    panels[0].legend(loc="lower right", fontsize=9, frameon=False, labelcolor="#333333")
    figure.savefig(out, dpi=DPI)


def _curves(panel: Axes, runs: Sequence[Trained]) -> None:
    for algo, color in ALGORITHMS.items():
        curves = [run.curve for run in runs if run.algo == algo]
        grid, returns = common_grid(curves)
        panel.fill_between(grid, returns.min(0), returns.max(0), color=color, alpha=0.15, linewidth=0)
        label = f"{algo.upper()}: median of {len(curves)} seeds, worst to best"
        panel.plot(grid, np.median(returns, 0), color=color, linewidth=2.0, label=label)


def main() -> None:
    parser = argparse.ArgumentParser(description="A2C and IMPALA with new and old weights")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="number of seeds, counted from 1")
    seeds = range(1, parser.parse_args().seeds + 1)
    plan = [(algo, max_lag, seed) for max_lag in LAGS for algo in ALGORITHMS for seed in seeds]
    runs = [train(*each) for each in track(plan, "training")]
    Console().print(show(runs))
    rows = [{name: value for name, value in run._asdict().items() if name != "curve"} for run in runs]
    write("off_policy", {"settings": SETTINGS, "runs": rows})
    draw(runs, PNG)
    Console().print(f"drawn: {PNG}")


if __name__ == "__main__":
    main()
