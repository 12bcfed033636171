"""Memory of all processes of a CartPole-v1 run, compared with Stable-Baselines3: `python -m benchmarks.memory`.

It reports the peak memory of the whole process tree. Pages of files (libraries) are counted once for all processes; private
pages are added up. PSS isn't used, because it divides the pages of a library among all programs on the machine, so another
program with torch would halve it.
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from benchmarks.programs import CONTENDERS, OURS, ZOO, contenders, run
from benchmarks.writing import bars, write

STEPS = 20_000
TARGET_WORKER_MB = 70
INTERVAL_S = 0.3  # minimum time between two measurements


class Tree:
    """Peak memory of a process and its descendants, in MB."""

    def __init__(self) -> None:
        self.own = self.rss = self.child_rss = 0.0
        self.processes = 0
        self._due_s = 0.0

    def measure(self, pid: int) -> None:
        """Measure the memory, unless less than `INTERVAL_S` has passed since the last measurement."""
        if time.monotonic() < self._due_s:
            return
        try:
            root = psutil.Process(pid)
            tree = [root, *root.children(recursive=True)]
        except psutil.NoSuchProcess:
            return
        files: dict[str, int] = {}
        own = rss = 0
        for process in tree:
            try:
                maps: list[Any] = process.memory_maps(grouped=True)
            except (psutil.NoSuchProcess, psutil.AccessDenied, FileNotFoundError):
                continue
            resident = sum(each.rss for each in maps)
            for each in maps:
                written = each.private_dirty if each.path.startswith("/") else each.rss
                own += written
                files[each.path] = max(files.get(each.path, 0), each.rss - written)
            rss += resident
            if process is not root:
                self.child_rss = max(self.child_rss, resident / 1e6)
        self.own = max(self.own, (own + sum(files.values())) / 1e6)
        self.rss = max(self.rss, rss / 1e6)
        self.processes = max(self.processes, len(tree))
        self._due_s = time.monotonic() + INTERVAL_S


def measure_run(contender: str) -> Tree:
    """The memory of one run."""
    tree = Tree()
    run(contender, ZOO | {"steps": STEPS, "seed": 1}, look=tree.measure)
    return tree


def main() -> None:
    parser = argparse.ArgumentParser(description="memory of all processes of a CartPole run")
    parser.add_argument("--rounds", type=int, default=2)
    rounds = parser.parse_args().rounds
    names = [name for name in contenders() if not CONTENDERS[name].own]
    turns = [{name: measure_run(name) for name in names} for _ in range(rounds)]
    rows = [
        {
            "contender": name,
            "processes": max(turn[name].processes for turn in turns),
            "own_mb": statistics.median(turn[name].own for turn in turns),
            "rss_mb": statistics.median(turn[name].rss for turn in turns),
            "largest_child_rss_mb": statistics.median(turn[name].child_rss for turn in turns),
        }
        for name in names
    ]
    table = Table(title=f"PPO, CartPole-v1, 8 copies: memory of all processes, medians of {rounds}")
    for column in ("", "processes", "together, MB", "sum of RSS", "largest child, RSS", "target"):
        table.add_column(column, justify="left" if column == "" else "right")
    for row in rows:
        figures = (f"{row[key]:.0f}" for key in ("own_mb", "rss_mb", "largest_child_rss_mb"))
        target = f"a worker ≤ {TARGET_WORKER_MB}" if row["contender"] == OURS else ""
        table.add_row(str(row["contender"]), str(row["processes"]), *figures, target)
    Console(width=120).print(table)
    write("memory", {"memory": rows}, [("memory of all processes, MB", bars(rows, "contender", "own_mb"))])


if __name__ == "__main__":
    main()
