"""PPO on CartPole-v1 beside Stable-Baselines3, with the same hyperparameters: `python -m benchmarks.train`.

Env steps/s from the third update on; and seconds from the command (imports, start and evaluations included) until a greedy
evaluation of 20 episodes, one every 5,000 env steps, averages 475 and the program has ended. Each is a process tree of its
own, started cold; all take turns. A subprocess for each of 64 copies is more than this machine holds: left out.
"""

from __future__ import annotations

import argparse
import statistics
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.programs import SETTINGS, SUBPROC, ZOO, contenders, run
from benchmarks.writing import bars, write

WARM_UP = 2  # updates
TARGET = 5.0  # times the env steps/s of Stable-Baselines3's best
SOLVED, MOST_STEPS = 475.0, 150_000


def rate(contender: str, settings: dict[str, Any]) -> float:
    """Env steps/s."""
    updates = run(contender, settings).updates
    (first, began_s), (last, ended_s) = updates[WARM_UP], updates[-1]
    return (last - first) / (ended_s - began_s)


def speeds(name: str, steps: int, rounds: int) -> list[dict[str, object]]:
    """A row for each contender with these settings."""
    settings = SETTINGS[name]
    names = [one for one in contenders() if one != SUBPROC or settings["envs"] <= 8]
    turns = [{one: rate(one, settings | {"steps": steps, "seed": turn + 1}) for one in names} for turn in range(rounds)]

    def against_best(one: str, turn: dict[str, float]) -> float:
        return turn[one] / max((speed for peer, speed in turn.items() if peer != names[0]), default=float("nan"))

    return [
        {
            "settings": name,
            "contender": one,
            "env_steps_per_s": round(statistics.median(turn[one] for turn in turns)),
            "least": round(min(turn[one] for turn in turns)),
            "most": round(max(turn[one] for turn in turns)),
            "of_best_peer": statistics.median(against_best(one, turn) for turn in turns),
        }
        for one in names
    ]


def solving(rounds: int) -> list[dict[str, object]]:
    """A row for each contender: seconds from the command to a solved CartPole, and how many env steps that took."""
    found: dict[str, list[tuple[float, int]]] = {one: [] for one in contenders()}
    for turn in range(rounds):
        for one, runs in found.items():
            ran = run(one, ZOO | {"steps": MOST_STEPS, "seed": turn + 1}, SOLVED)
            runs.append((ran.wall_s, ran.updates[-1][0]))
    return [
        {
            "contender": one,
            "seconds": statistics.median(seconds for seconds, _ in runs),
            "least": min(seconds for seconds, _ in runs),
            "most": max(seconds for seconds, _ in runs),
            "env_steps": round(statistics.median(steps for _, steps in runs)),
        }
        for one, runs in found.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="PPO on CartPole-v1 beside Stable-Baselines3")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, nargs=2, default=(16_000, 66_000), help="env steps of a turn, by settings")
    arguments = parser.parse_args()
    console = Console(width=120)
    rows = [
        row for name, steps in zip(SETTINGS, arguments.steps, strict=True) for row in speeds(name, steps, arguments.rounds)
    ]
    table = Table(title=f"PPO, CartPole-v1, medians of {arguments.rounds}")
    for column in ("settings", "", "env steps/s", "least to most", "× best peer", "target"):
        table.add_column(column, justify="left" if column in ("settings", "") else "right")
    for row in rows:
        ours = str(row["contender"]).startswith("millrace")
        speed = f"{row['env_steps_per_s']:,}", f"{row['least']:,} to {row['most']:,}"
        target = f"≥ {TARGET:g}" if ours else ""
        table.add_row(str(row["settings"]), str(row["contender"]), *speed, f"{row['of_best_peer']:.2f}", target)
    console.print(table)
    solved = solving(arguments.rounds)
    table = Table(title=f"From the command to a greedy mean of {SOLVED:g}, 8 × 32, medians of {arguments.rounds} seeds")
    for column in ("", "seconds", "least to most", "env steps"):
        table.add_column(column, justify="left" if column == "" else "right")
    for row in solved:
        spread = f"{row['least']:.1f} to {row['most']:.1f}"
        table.add_row(str(row["contender"]), f"{row['seconds']:.1f}", spread, f"{row['env_steps']:,}")
    console.print(table)
    charts = [(f"env steps/s, {name}", bars(rows, "contender", "env_steps_per_s", name)) for name in SETTINGS]
    charts.append(("seconds to a solved CartPole", bars(solved, "contender", "seconds")))
    write("train", {"speeds": rows, "solving": solved}, charts)


if __name__ == "__main__":
    main()
