"""The lines, bands, dots and legends of learning curves, in the report and in the picture of `millrace plot`. Pure.

There is a panel for each environment, and a color for each group of runs. In a group of several runs, each run is a thin
line, their mean is a bold line, and a band reaches from the worst to the best run. If an error or an interrupt ended a run,
the run is a thin line but isn't part of the mean, and the legend says so.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from millrace.extras.monitoring.report.charts import DOT_KEY, Series, key
from millrace.extras.monitoring.report.curve import common_grid
from millrace.extras.monitoring.report.html_parts import return_text
from millrace.extras.monitoring.report.reported_runs import ReportData, RunGroup
from millrace.learner.run_folder.episode_window import WINDOW_EPISODES

WHAT_IS_DRAWN = f"Return, mean of the last {WINDOW_EPISODES} training episodes"


class Panel(NamedTuple):
    """The learning curves of one environment."""

    env: str
    series: list[Series]
    legend: list[tuple[str, str]]
    """pairs of an SVG key and its text"""


def panels(report: ReportData) -> list[Panel]:
    """The panels, one for each environment."""
    drawn = []
    for env in report.envs:
        groups = [group for group in report.groups if group.env == env]
        series = [series for group in groups for series in _series(group)]
        legend = [(key(group.color), group.legend()) for group in groups]
        if any(each.kind == "dots" for each in series):
            legend.append((DOT_KEY, "greedy evaluations"))
        drawn.append(Panel(env, series, legend))
    return drawn


def how_it_is_drawn(report: ReportData) -> str:
    """Text that explains bold and thin lines and bands; empty if no group has a mean."""
    if not any(group.averaged for group in report.groups):
        return ""
    return "Bold: the mean over seeds, as far as the shortest of them goes. Band: from the worst to the best. Thin: a seed."


def _series(group: RunGroup) -> Iterable[Series]:
    averaged = group.averaged
    for curve in group.curves:
        last = f"{return_text(float(curve.returns[-1]))} at {curve.env_steps[-1]:,.0f} env steps"
        tooltip = f"{group.name}, seed {curve.seed}: {last}"
        yield Series("thin" if averaged else "line", group.color, curve.env_steps, curve.returns, tooltip)
    for run in group.runs:
        if len(run.evaluations):
            steps, returns = run.evaluations.T
            yield Series("dots", group.color, steps, returns, f"{group.name}, seed {run.seed}: greedy evaluations")
    if averaged:
        grid, returns = common_grid(averaged)
        if grid.size:
            band = np.column_stack([returns.min(0), returns.max(0)])
            yield Series("band", group.color, grid, band)
            yield Series("line", group.color, grid, returns.mean(0), f"{group.name}: mean of {len(averaged)}")
