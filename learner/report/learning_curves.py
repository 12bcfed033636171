"""Draws learning curves of run folders as a PNG. Without global state: matplotlib's pyplot is not used.

There is a panel for each environment, which its id and its keyword arguments tell apart, and a color for each group of runs.
As in the report, runs of a group have the same settings, except the seed and the folder. Of a group of several runs, each
run is a thin line, their mean is a bold line, and a band reaches from the worst to the best. A run that an error or an
interrupt ended is a thin line and in no mean; the legend says so. If an algorithm has several groups, the legend says in
which settings they differ.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from learner.report.curve import Curve, common_grid, read_run_files
from learner.report.reported_runs import RunGroup, group_runs, read_run
from learner.run_folder.atomic_write import write_file
from learner.run_folder.episode_window import WINDOW_EPISODES
from protocol.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from learner.report.figure import PngFigure

PANEL_INCHES = (6.4, 4.2)
COLUMNS = 3
LABEL_WIDTH, LINE_INCHES = 80, 0.2  # of a legend below a panel: characters in a line, and its height
DPI = 150
COLORS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#000000",
)  # Okabe and Ito: distinguishable for color-blind readers
GREY = "#555555"

log = logging.getLogger("millrace.learner")


def read_curve(run: Path) -> Curve:
    """The learning curve of a run folder. Raises `UsageError`, with a one-line message, if the folder has none."""
    curve = read_run_files(run).curve()
    if curve is None:
        raise UsageError(nothing_to_plot(run))
    return curve


def nothing_to_plot(run: Path) -> str:
    """The line about a run folder in whose metrics no episode has ended."""
    return f"run {run}: nothing to plot, no episode has ended"


def plot(runs: Sequence[Path], out: Path) -> Path:
    """Draw the runs into `out`. Raises `UsageError` for a folder that cannot be read, `RunError` if `out` is not written."""
    write(curves(runs), out)
    return out


def write(figure: PngFigure, out: Path) -> None:
    """Write the figure as a PNG. Raises `RunError`."""
    write_file(out, lambda file: figure.savefig(file, format="png", dpi=DPI))


def curves(runs: Sequence[Path]) -> PngFigure:
    """Draw the runs, without those in which no episode has ended: a warning names each.

    Raises `UsageError` for a folder that cannot be read, and if there is nothing to draw.
    """
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    from learner.report.figure import PngFigure

    found = [read_run(run) for run in dict.fromkeys(runs)]
    read = [run for run in found if run.curve is not None]
    empty = [nothing_to_plot(run.path) for run in found if run.curve is None]
    if not read:
        raise UsageError(empty[0])
    for line in empty:
        log.warning("%s; it is left out", line)
    groups = group_runs(read).groups
    envs, names = sorted({group.env for group in groups}), sorted({group.name for group in groups})
    columns = min(len(envs), COLUMNS)
    rows = math.ceil(len(envs) / columns)
    lines = max(_legend_lines([group for group in groups if group.env == env]) for env in envs)
    size = PANEL_INCHES[0] * columns, (PANEL_INCHES[1] + LINE_INCHES * lines) * rows
    figure = PngFigure(figsize=size, layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[len(envs) :]:
        panel.set_axis_off()
    for env, panel in zip(envs, panels, strict=False):
        for group in groups:
            if group.env == env:
                _draw(panel, group, COLORS[names.index(group.name) % len(COLORS)])
        _style_axes(panel, env, below=lines > 0)
    return figure


def _draw(panel: Axes, group: RunGroup, color: str) -> None:
    lines, averaged = group.curves, group.averaged
    for number, curve in enumerate(lines):
        width, alpha = (0.6, 0.35) if averaged else (1.8, 1.0)
        label = "" if averaged or number else group.legend()
        panel.plot(curve.env_steps, curve.returns, color=color, linewidth=width, alpha=alpha, label=label)
    if averaged:
        kind = "seed" if len({curve.seed for curve in averaged}) == len(averaged) else "run"
        band = f"{group.label}, worst to best {kind}"
        grid, returns = common_grid(averaged)
        panel.fill_between(grid, returns.min(0), returns.max(0), color=color, alpha=0.15, linewidth=0, label=band)
        panel.plot(grid, returns.mean(0), color=color, linewidth=2.0, label=group.legend())


def _style_axes(panel: Axes, env: str, *, below: bool) -> None:
    """`below`: the legend is below the panel, in lines of at most LABEL_WIDTH characters."""
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
    look: dict[str, Any] = {"fontsize": 9, "frameon": False, "labelcolor": "#333333", "loc": "best"}
    if below:
        labels = [fill(label, LABEL_WIDTH) for label in labels]
        look |= {"loc": "upper left", "bbox_to_anchor": (-0.1, -0.16)}
    panel.legend(handles[::-1], labels[::-1], **look)


def _legend_lines(groups: Sequence[RunGroup]) -> int:
    """How many lines the legend of a panel has below it; 0 if its texts are short: then it is in the panel."""
    legends = [group.legend() for group in groups]
    if max(map(len, legends)) <= LABEL_WIDTH // 2:
        return 0
    bands = [f"{group.label}, worst to best seed" for group in groups if group.averaged]
    return sum(len(fill(label, LABEL_WIDTH).split("\n")) for label in (*legends, *bands))
