"""SAC at replay ratio 1 with eight workers and steps that take 10 ms: `python -m benchmarks.slow_replay`.

Two rates limit such a run: the rate of the workers if there are no gradient steps, and the rate of the learner if env steps
take no time. A run can at best reach the lower one. The environment sleeps (`benchmarks/slow_env.py`), so eight workers
don't need eight cores. All runs take turns. Env steps/s are measured after the first updates with gradient steps.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import statistics
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.programs import Contender, run
from benchmarks.writing import write

WORKERS = 8
WARM_UP_STEPS = 640  # number of env steps that aren't counted
SETTINGS: dict[str, Any] = {
    "algo": "sac", "envs": WORKERS, "rollout_steps": 8, "batch_size": 256, "learning_rate": 1e-3, "learning_starts": 128,
    "replay_size": 50_000, "updates_per_step": 1.0, "eval_every": 0, "eval_episodes": 1,
}  # fmt: skip
SLOW = {"env": "benchmarks.slow_env:TenMilliseconds-v0"}
FAST = {"env": "Pendulum-v1"}
NO_UPDATES = {"learning_starts": 10**9}
WORKERS_ALONE = "the workers alone"
LEARNER_ALONE = "the learner alone"


def rate(settings: dict[str, Any], max_lag: int, steps: int, seed: int) -> float:
    """Env steps/s after the warm-up."""
    flags = ("--workers", str(WORKERS), "--lanes", str(WORKERS), "--max-lag", str(max_lag))
    settings = SETTINGS | settings | {"steps": steps, "seed": seed}
    return run("millrace", settings, contender=Contender("millrace", flags=flags)).steps_per_s(after_steps=WARM_UP_STEPS)


def main() -> None:
    parser = argparse.ArgumentParser(description="compare SAC on slow environments with what workers and learner allow")
    parser.add_argument("--rounds", type=int, default=3, help="number of turns, each with another seed")
    parser.add_argument("--steps", type=int, default=5000, help="env steps of a run")
    arguments = parser.parse_args()
    found: dict[tuple[int, str], list[float]] = {}
    for seed in range(1, arguments.rounds + 1):
        for width in (64, 256):
            net = {"net": [width, width]}
            of: dict[str, tuple[dict[str, Any], int]] = {
                WORKERS_ALONE: (net | SLOW | NO_UPDATES, 1),
                LEARNER_ALONE: (net | FAST, 1),
            }
            of |= {f"--max-lag {lag}": (net | SLOW, lag) for lag in (0, 1, 2)}
            for name, (settings, max_lag) in of.items():
                found.setdefault((width, name), []).append(rate(settings, max_lag, arguments.steps, seed))
    table = Table("units", "run", "median", "all turns", "share of the slower of both")
    rows = []
    for (width, name), numbers in found.items():
        most = [min(both) for both in zip(found[width, WORKERS_ALONE], found[width, LEARNER_ALONE], strict=True)]
        share = statistics.median(number / bound for number, bound in zip(numbers, most, strict=True))
        rows.append({"units": width, "run": name, "median": statistics.median(numbers), "turns": numbers, "share": share})
        turns = ", ".join(f"{number:,.0f}" for number in numbers)
        table.add_row(str(width), name, f"{statistics.median(numbers):,.0f}", turns, f"{share:.2f}")
    Console(width=120).print(table)
    write("slow_replay", {"settings": SETTINGS, "rows": rows})


if __name__ == "__main__":
    main()
