"""Writes the results of a benchmark: JSON, with machine, versions, commit and load, and a bar chart."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from millrace.learner.run_folder.run_format import versions

RESULTS = Path(__file__).parent / "results"
DPI = 150
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")  # Okabe and Ito
GREY = "#555555"
Bars = tuple[str, Mapping[str, float]]
"""A bar chart: its title, and the length of each bar by its label"""


def circumstances() -> dict[str, object]:
    """Date, commit, machine, load and versions."""
    return {
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "machine": platform.platform(),
        "cores": os.cpu_count(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "versions": versions(),
    }


def processor() -> str:
    """The number of cores of this machine, and the processor's name as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{cores} cores of {names[0] if names else platform.machine()}"


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, cwd=RESULTS.parent, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def write(name: str, record: Mapping[str, Any], charts: Sequence[Bars] = ()) -> None:
    """Write the record to results/NAME.json, and the charts, if there are any, to results/NAME.png."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps({"circumstances": circumstances(), **record}, indent=2) + "\n")
    if charts:
        _draw(charts, RESULTS / f"{name}.png")


def bars(rows: Sequence[Mapping[str, object]], label: str, length: str, first: object = None) -> dict[str, float]:
    """A bar for each row, or for each row whose first field is `first`. `label` and `length` are names of fields."""
    chosen = [row for row in rows if first is None or next(iter(row.values())) == first]
    return {str(row[label]): float(str(row[length])) for row in chosen}


def _number_text(number: float) -> str:
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def _draw(charts: Sequence[Bars], out: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    heights = [len(bars) + 1 for _, bars in charts]
    figure = Figure(figsize=(8.0, 0.8 + 0.32 * sum(heights)), layout=ConstrainedLayoutEngine())
    panels = figure.subplots(len(charts), 1, squeeze=False, height_ratios=heights)[:, 0]
    for panel, (title, bars) in zip(panels, charts, strict=True):
        ours = [label for label in bars if label.startswith(("millrace", "ours"))] or list(bars)
        colors = [COLORS[0] if label in ours else "#bbbbbb" for label in bars]
        drawn = panel.barh(list(bars), list(bars.values()), color=colors)
        panel.bar_label(drawn, [_number_text(length) for length in bars.values()], padding=3, fontsize=8, color=GREY)
        panel.set_title(title, fontsize=10, fontweight="bold", loc="left")
        panel.invert_yaxis()
        panel.margins(x=0.12)
        panel.tick_params(labelsize=8, colors=GREY, length=0)
        panel.xaxis.set_visible(False)
        for spine in panel.spines.values():
            spine.set_visible(False)
    figure.savefig(out, dpi=DPI)
