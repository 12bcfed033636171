"""Compares the recommendations of `millrace plan` with runs: `python -m benchmarks.plan`, or `millrace bench plan`.

For each of eight environments (`benchmarks/plan_envs.py`) it makes a plan. Then it trains with the plan's algorithm, env
copies and rollout steps on a grid of workers, lanes and lags, and measures the env steps/s of each run after its first
updates. It reports how close the recommended settings come to the grid's best, and how close the expected speed is to the
measured one. The runs of a grid take turns. An algorithm with a replay buffer takes gradient steps from the second update
on.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

import millrace
from benchmarks import plan_envs
from benchmarks.writing import write
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.protocol.machine.cpu_cores import usable_cores

ENVS = {
    "fast": "Fast",
    "waits for 5 ms": "Waits",
    "computes for 20 ms": "Computes",
    "uneven, 5 ms": "Uneven",
    "resets of 300 ms": "LongResets",
    "16 KB observations": "LargeObservations",
    "not deterministic": "NotDeterministic",
    "three agents": "Agents",
}
LAGS = (0, 1, 2)
Cell = tuple[int, int, int]
"""A point of the grid: workers, lanes, lag"""


class Watch(millrace.Callback):
    """Ends a run when it has been measured for some seconds and some updates."""

    LEAST_UPDATES = 2
    LONGEST = 3.0  # after this multiple of the seconds, one update is enough

    def __init__(self, seconds: float, warm_up: int) -> None:
        """`seconds`: how long to measure. `warm_up`: number of first updates that aren't counted."""
        self._seconds = seconds
        self._warm_up = warm_up
        self.updates: list[tuple[float, int]] = []
        """for each update, the time of its end, and the env steps until then"""

    def on_update(self, progress: millrace.Progress) -> bool:
        """Record the update. Returns False to end the run."""
        self.updates.append((time.monotonic(), progress.env_steps))
        counted = self.updates[self._warm_up :]
        if len(counted) < 2:
            return True
        took_s = counted[-1][0] - counted[0][0]
        least = self.LEAST_UPDATES if took_s < self.LONGEST * self._seconds else 1
        return len(counted) <= least or took_s < self._seconds

    @property
    def steps_per_s(self) -> float:
        """Env steps/s after the warm-up."""
        (began_s, before), *_, (ended_s, after) = self.updates[self._warm_up :]
        return (after - before) / (ended_s - began_s)


def grid(plan: millrace.RunPlan) -> Iterator[Cell]:
    """The cells to compare a plan with: several numbers of workers, each with as few and as many lanes as possible.

    With the plan's number of workers, all lags are tried; otherwise only the plan's lag.
    """
    envs = plan.settings["envs"]
    numbers = {1, usable_cores()} if plan.measured.alone.computes else {-(-envs // 2), envs}
    numbers.add(plan.settings["workers"])
    for workers in sorted(number for number in numbers if number <= envs):
        for lanes in sorted({workers, envs}):
            if workers <= lanes and envs % lanes == 0:
                for lag in LAGS if workers == plan.settings["workers"] else [plan.settings["max_lag"]]:
                    yield workers, lanes, lag


def rate(env: str, settings: dict[str, Any], cell: Cell, seconds: float) -> float:
    """Env steps/s of a run with these settings, except for the workers, lanes and lag of this cell."""
    workers, lanes, lag = cell
    changed = settings | {"workers": workers, "lanes": lanes, "max_lag": lag}
    if "learning_starts" in HYPERPARAMETERS[settings["algo"]].__struct_fields__:
        changed |= {"learning_starts": 1}
    watch = Watch(seconds, warm_up=1 + lag)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        millrace.train(
            env,
            callbacks=[watch],
            progress=False,
            run_dir=folder,
            steps=10_000_000,
            eval_episodes=1,
            eval_max_steps=1,
            **changed,
        )
    return watch.steps_per_s


def compared(names: Sequence[str], seconds: float, rounds: int, say: Any, *, with_grid: bool) -> dict[str, dict[str, Any]]:
    """For each environment, its plan and the env steps/s of each cell in its grid (or only of the plan's cell)."""
    found = {}
    for name in names:
        env = f"{plan_envs.__name__}:{ENVS[name]}"
        plan = millrace.plan(env)
        settings = plan.settings
        chosen = (settings["workers"], settings["lanes"], settings["max_lag"])
        say(f"{name}: {plan.command}, {plan.steps_per_s:,.0f} env steps/s expected")
        cells = [chosen, *(cell for cell in grid(plan) if cell != chosen and with_grid)]
        rates: dict[Cell, list[float]] = {cell: [] for cell in cells}
        for _ in range(rounds):
            for cell in cells:
                rates[cell].append(rate(env, settings, cell, seconds))
                say(f"  {cell}: {rates[cell][-1]:,.0f}")
        medians = {cell: statistics.median(of_cell) for cell, of_cell in rates.items()}
        best = max(medians, key=lambda cell: medians[cell])
        found[name] = {
            "settings": settings,
            "expected": plan.steps_per_s,
            "measured": medians[chosen],
            "best": medians[best],
            "best_cell": best,
            "cells": [[*cell, rate_of_cell] for cell, rate_of_cell in medians.items()],
        }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="compare what `millrace plan` says with a grid of runs")
    parser.add_argument("--envs", nargs="*", default=[*ENVS], choices=[*ENVS], help="these environments only")
    parser.add_argument("--seconds", type=float, default=3.0, help="of each run, after its first updates")
    parser.add_argument("--rounds", type=int, default=1, help="runs of each cell")
    parser.add_argument("--only-chosen", action="store_true", help="run what was recommended, and no grid")
    arguments = parser.parse_args()
    console = Console(width=120)
    with_grid = not arguments.only_chosen
    found = compared(arguments.envs, arguments.seconds, arguments.rounds, console.print, with_grid=with_grid)
    table = Table(title="millrace plan, compared with runs: env steps/s")
    for column in ("", "chosen", "expected", "measured", "expected / measured", "best of the grid", "measured / best"):
        table.add_column(column, justify="left" if not column else "right")
    for name, each in found.items():
        chosen = each["settings"]
        workers, lanes, lag = each["best_cell"]
        table.add_row(
            name,
            f"{chosen['algo']}, {chosen['envs']} copies: {chosen['workers']}, {chosen['lanes']}, {chosen['max_lag']}",
            f"{each['expected']:,.0f}",
            f"{each['measured']:,.0f}",
            f"{each['expected'] / each['measured']:.2f}",
            f"{each['best']:,.0f} ({workers}, {lanes}, {lag})",
            f"{each['measured'] / each['best']:.2f}",
        )
    console.print(table)
    console.print("chosen and best: workers, lanes, lag")
    write("plan", {"of": found}, [])


if __name__ == "__main__":
    main()
