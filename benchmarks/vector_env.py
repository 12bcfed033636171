"""Vector environments of CartPole-v1 under random actions, env steps/s: `python -m benchmarks.vector_env`.

gymnasium's Sync and Async (shared memory), Stable-Baselines3's Dummy and Subproc, ours on two workers (through shared
memory, and by messages over ipc and tcp), and the limit: two processes that each step half of the copies in a bare loop and
answer nobody. All actions are drawn beforehand. All take turns; medians of rounds, ratios within each round.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import json
import statistics
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from rich.console import Console
from rich.table import Table

import millrace
from benchmarks.collect import Pair

RESULTS = Path(__file__).parent / "results"
ENV = "CartPole-v1"
COPIES = (8, 16, 64)
WORKERS = 2
OURS: dict[str, dict[str, Any]] = {
    "millrace": {},
    "millrace, messages, ipc": {"shared_memory": False},
    "millrace, messages, tcp": {"transport": "tcp", "shared_memory": False},
}
CONTENDERS = (
    "gymnasium Sync", "gymnasium Async", "SB3 DummyVecEnv", "SB3 SubprocVecEnv", *OURS, "bare loop, 2 processes",
)  # fmt: skip


class Contender:
    """A vector environment that goes on stepping."""

    def __init__(self, env: Any, copies: int) -> None:
        self._env, self._copies = env, copies
        self._actions = np.random.default_rng(copies).integers(2, size=(1000, copies))
        if hasattr(env, "seed"):  # SB3
            env.seed(1)
            env.reset()
        else:
            env.reset(seed=1)
        self.close: Callable[[], None] = env.close

    def rate(self, seconds: float) -> float:
        """Env steps/s."""
        steps, start = 0, time.perf_counter()
        while (now := time.perf_counter()) - start < seconds:
            self._env.step(self._actions[steps % len(self._actions)])
            steps += 1
        return steps * self._copies / (now - start)


def make(name: str, copies: int) -> Contender | Pair:
    def one() -> gymnasium.Env[Any, Any]:
        return gymnasium.make(ENV)

    match name:
        case "gymnasium Sync":
            return Contender(SyncVectorEnv([one] * copies), copies)
        case "gymnasium Async":
            return Contender(AsyncVectorEnv([one] * copies), copies)
        case "SB3 DummyVecEnv" | "SB3 SubprocVecEnv":
            from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                kind = DummyVecEnv if name == "SB3 DummyVecEnv" else SubprocVecEnv
                return Contender(kind([one] * copies), copies)
        case "bare loop, 2 processes":
            return Pair("bare, drawn", copies // 2)
        case _:
            return Contender(millrace.make_vec(ENV, copies, workers=WORKERS, **OURS[name]), copies)


def stepping(copies: int, rounds: int, seconds: float) -> list[dict[str, object]]:
    """A row for each contender: its rate and, by rounds, its share of gymnasium's Async and of the limit."""
    contenders = {name: make(name, copies) for name in CONTENDERS}
    for contender in contenders.values():
        contender.rate(0.2)  # warm up
    turns = [{name: contender.rate(seconds) for name, contender in contenders.items()} for _ in range(rounds)]
    for contender in contenders.values():
        contender.close()
    return [
        {
            "copies": copies,
            "contender": name,
            "env_steps_per_s": round(statistics.median(turn[name] for turn in turns)),
            "of_async": statistics.median(turn[name] / turn["gymnasium Async"] for turn in turns),
            "of_limit": statistics.median(turn[name] / turn["bare loop, 2 processes"] for turn in turns),
        }
        for name in CONTENDERS
    ]


def show(rows: list[dict[str, object]], rounds: int) -> Table:
    table = Table(title=f"{ENV}, random actions, {WORKERS} workers, medians of {rounds}")
    for column in ("copies", "", "env steps/s", "× gymnasium Async", "of the limit"):
        table.add_column(column, justify="left" if column == "" else "right")
    for row in rows:
        ratios = f"{row['of_async']:.1f}", f"{row['of_limit']:.2f}"
        table.add_row(str(row["copies"]), str(row["contender"]), f"{row['env_steps_per_s']:,}", *ratios)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description="vector environments under random actions")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each turn")
    arguments = parser.parse_args()
    rows = [row for copies in COPIES for row in stepping(copies, arguments.rounds, arguments.seconds)]
    Console().print(show(rows, arguments.rounds))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "vector_env.json").write_text(json.dumps({"vector_env": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
