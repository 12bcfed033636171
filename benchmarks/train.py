"""Compares training on CartPole-v1 with Stable-Baselines3, with the same hyperparameters: `python -m benchmarks.train`.

`--peers` adds all other systems that `python -m benchmarks.peers.install` has installed, memory, and Stable-Baselines3's A2C
and DQN. Env steps/s are measured from the third update on. The time to solve the task is measured from the start of the
command (with imports and evaluations) until the mean return of a greedy evaluation reaches 475; for millrace, until the
program has ended. There is an evaluation of 20 episodes every 5,000 env steps. Each run is a process tree of its own with a
cold start; all take turns. A run that fails is reported and left out. The last row of the table is the speed that the
arithmetic alone would allow.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks.arithmetic import products_ms
from benchmarks.memory import Tree
from benchmarks.programs import A2C, CONTENDERS, DQN, DUMMY, LARGE, OURS, OURS_OWN, SUBPROC, ZOO, contenders, missing, run
from benchmarks.update_ppo import contest
from benchmarks.writing import bars, write

WARM_UP = 2  # number of updates that aren't counted
TARGET = 5.0  # target for env steps/s, as a multiple of Stable-Baselines3's best
SOLVED = 475.0
NAN = math.nan


class Measure(NamedTuple):
    """A measurement, which each contender undergoes in every turn."""

    column: str
    settings: dict[str, Any]
    steps: int
    kind: str
    """rate, solved or memory"""

    def fits(self, contender: str) -> bool:
        """Whether this measurement is made for this contender."""
        each = CONTENDERS[contender]
        if self.settings["algo"] != "ppo":
            among = (OURS, DUMMY, SUBPROC) if self.settings["algo"] == "a2c" else (OURS, DUMMY)
            return contender in among or (contender == OURS_OWN and self.kind == "solved")
        if contender == OURS_OWN:
            return False  # PPO's preset has the same settings
        if each.ours and each.own and self.kind != "rate":
            return False  # as their settings differ, only env steps/s are measured
        return self.settings["envs"] <= each.most_envs and not (each.own and self.settings is LARGE)

    def of(self, contender: str, seed: int) -> dict[str, float]:
        """Run the contender. Returns one or two numbers, by column of the table. Raises `RuntimeError` if the run fails."""
        settings = self.settings | {"steps": self.steps, "seed": seed}
        match self.kind:
            case "rate":
                return {self.column: run(contender, settings).steps_per_s(after_updates=WARM_UP)}
            case "memory":
                tree = Tree()
                run(contender, settings, look=tree.measure)
                return {self.column: tree.own}
            case _:
                ran = run(contender, settings, SOLVED)
                steps = NAN if math.isnan(ran.solved_s) else ran.updates[-1][0]
                return {self.column: ran.solved_s, f"{self.column}, env steps": steps}


SMALL_RATE = "env steps/s, 8 × 32"
LARGE_RATE = "env steps/s, 64 × 128"
SECONDS = "solved, s"
MEMORY = "memory, MB"
PPO_MEASURES = [
    Measure(SMALL_RATE, ZOO, 30_000, "rate"),
    Measure(LARGE_RATE, LARGE, 150_000, "rate"),
    Measure(SECONDS, ZOO, 150_000, "solved"),
]
PEERS_MEASURES = [
    Measure(MEMORY, ZOO, 6_000, "memory"),
    Measure("A2C, env steps/s", A2C, 30_000, "rate"),
    Measure("A2C solved, s", A2C, 300_000, "solved"),
    Measure("DQN, env steps/s", DQN, 8_000, "rate"),
    Measure("DQN solved, s", DQN, 50_000, "solved"),
]
Turn = dict[str, dict[str, float]]
"""The measured numbers, by contender and column"""


def take_turns(names: list[str], measures: list[Measure], seed: int) -> Turn:
    """Make each measurement of each contender once."""
    turn: Turn = {name: {} for name in names}
    for measure in measures:
        for name in filter(measure.fits, names):
            try:
                turn[name] |= measure.of(name, seed)
            except RuntimeError as error:
                print(f"left out: {measure.column}: {error}", file=sys.stderr)
    return turn


def summary(names: list[str], turns: list[Turn]) -> list[dict[str, object]]:
    """A row for each contender, with medians and the numbers behind them."""
    rows: list[dict[str, object]] = []
    for name in names:
        asked = dict.fromkeys(column for turn in turns for column in turn[name])
        columns = {column: [turn[name][column] for turn in turns if column in turn[name]] for column in asked}
        rows.append(
            {"contender": name, "median": {column: _median(found) for column, found in columns.items()}, "of": columns}
        )
    return rows


def _median(found: list[float]) -> float:
    """The median. NaN (not solved) counts as larger than all other numbers."""
    return statistics.median_low(sorted(found, key=lambda x: (math.isnan(x), x))) if len(found) % 2 else _middle(found)


def _middle(found: list[float]) -> float:
    ordered = sorted(math.inf if math.isnan(x) else x for x in found)
    return statistics.median(ordered) if ordered and math.isfinite(statistics.median(ordered)) else NAN


def table(rows: list[dict[str, Any]], title: str, algo: str = "") -> Table:
    """A table of medians with minimum and maximum, for PPO or for another algorithm."""
    columns = [
        c for c in dict.fromkeys(c for row in rows for c in row["of"]) if c.startswith(algo or ("env", "solved", "mem"))
    ]
    shown = Table(title=title)
    shown.add_column("")
    for column in columns:
        shown.add_column(column.removeprefix(f"{algo} ").removeprefix(f"{algo}, "), justify="right")
    for row in rows:
        if set(columns) & set(row["of"]):
            shown.add_row(row["contender"], *(_cell(row["median"].get(c), row["of"].get(c, [])) for c in columns))
    return shown


def _cell(median: float | None, found: list[float]) -> str:
    if median is None or not found:
        return "–"
    places = 1 if max((x for x in found if not math.isnan(x)), default=0) < 1000 else 0
    reached = [x for x in found if not math.isnan(x)]
    if not reached:
        return "not solved"
    unsolved = "" if len(reached) == len(found) else f", {len(found) - len(reached)} not solved"
    middle = "–" if math.isnan(median) else f"{median:,.{places}f}"
    return f"{middle} ({min(reached):,.{places}f} to {max(reached):,.{places}f}{unsolved})" if len(found) > 1 else middle


def products_alone() -> dict[str, Any]:
    """The row of a learner that never waits, and whose updates consist only of matrix products on one core."""
    rates = {}
    for column, settings in ((SMALL_RATE, ZOO), (LARGE_RATE, LARGE)):
        minibatch = contest(settings["batch_size"], None)
        seconds = products_ms(minibatch.runs["graph"], minibatch.repeats) / 1e3
        rates[column] = settings["batch_size"] / (settings["n_epochs"] * seconds)
    return {
        "contender": "products of the updates alone",
        "median": rates,
        "of": {name: [rate] for name, rate in rates.items()},
    }


def against(rows: list[dict[str, Any]]) -> list[str]:
    """Lines that compare millrace with the best peer. Contenders with their own settings are compared only by seconds."""
    lines = []
    for column in (SMALL_RATE, LARGE_RATE, SECONDS):
        fast = max if column != SECONDS else min
        found = [(row["median"].get(column, NAN), row["contender"]) for row in rows]
        known = [(figure, who) for figure, who in found if math.isfinite(figure)]
        comparable = [(figure, who) for figure, who in known if column == SECONDS or not CONTENDERS[who].own]
        peers = [(figure, who) for figure, who in comparable if not CONTENDERS[who].ours]
        if peers:
            best, peer = fast(peers)
            each = [f"{who} {figure / best:.2f} ×" for figure, who in comparable if CONTENDERS[who].ours]
            lines.append(f"{column}, against the best peer, {peer}: {', '.join(each)}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description="compare CartPole-v1 with other systems, with the same hyperparameters")
    parser.add_argument("--rounds", type=int, default=3, help="number of turns, each with another seed")
    parser.add_argument("--peers", action="store_true", help="compare with all installed systems; also memory, A2C and DQN")
    arguments = parser.parse_args()
    names = [name for name in contenders(arguments.peers) if arguments.peers or not CONTENDERS[name].own]
    for name in missing() if arguments.peers else []:
        print(f"left out: {name} is not installed (python -m benchmarks.peers.install {name})", file=sys.stderr)
    measures = PPO_MEASURES + (PEERS_MEASURES if arguments.peers else [])
    turns: list[Turn] = []
    for turn in range(arguments.rounds):
        again = [measure for measure in measures if measure.kind != "memory" or not turns]  # memory hardly varies
        turns.append(take_turns(names, again, turn + 1))
        rows = summary(names, turns)
        charts = [(column, _bars(rows, column)) for column in (SMALL_RATE, LARGE_RATE, SECONDS)]
        write("train", {"rows": _without_nan(rows)}, charts)  # after each turn, in case a later one fails
    console = Console(width=140)
    console.print(table([*rows, products_alone()], f"PPO, CartPole-v1, medians of {arguments.rounds} (least to most)"))
    if arguments.peers:
        for algo in ("A2C", "DQN"):
            console.print(table(rows, f"{algo}, CartPole-v1, RL Zoo's settings", algo))
    for line in against(rows):
        console.print(line)
    console.print(f"aim: {TARGET:g} × the env steps/s of Stable-Baselines3, half of its seconds")


def _without_nan(data: Any) -> Any:
    """The data with None in place of NaN, because JSON has no NaN."""
    match data:
        case dict():
            return {key: _without_nan(value) for key, value in data.items()}
        case list():
            return [_without_nan(value) for value in data]
        case float() if math.isnan(data):
            return None
        case _:
            return data


def _bars(rows: list[dict[str, Any]], column: str) -> dict[str, float]:
    found = [{"who": row["contender"], "value": row["median"].get(column, NAN)} for row in rows]
    return bars([row for row in found if math.isfinite(row["value"])], "who", "value")


if __name__ == "__main__":
    main()
