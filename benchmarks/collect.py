"""Collecting CartPole-v1 in two processes, ours against the bare loop over the same copies: `python -m benchmarks.collect`.

Ours is `workers.collector.Collector`, as a worker runs it: a policy 4-64-64-2 acts in numpy, rows of T = 128 steps are
stored with their log-probabilities, episodes are counted. The bare loop takes random actions, keeps nothing and resets at
an episode's end. It comes in two kinds: `sampled`, the one that counts, is `gymnasium.make` as it comes and
`action_space.sample()`, as the field measures it (about 265k steps/s on two cores); `drawn` is the fastest that a loop
over these copies can be: gymnasium's checker left out, as we leave it out, and all actions drawn beforehand.

All take turns, one pair of processes at a time, one thread each; medians of rounds.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import json
import multiprocessing
import statistics
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import gymnasium
import numpy as np
from rich.console import Console
from rich.table import Table

from protocol.policy import NumpyPolicy, buffer_size, layout, size
from protocol.specs import ActionSpec, EnvSpec, Leaf, PolicySpec, RunSpec
from workers.collector import Collector
from workers.session import Assignment

RESULTS = Path(__file__).parent / "results"
TARGETS = {64: 0.75, 8: 0.6}  # copies in each process -> what our share of the bare loop must be
PROCESSES = 2
STEPS = 128  # T
ENV = EnvSpec("CartPole-v1")
POLICY = PolicySpec((Leaf("", "box", (4,), "float32"),), ActionSpec("discrete", (), "int64", (2,), (0,)))

Loop = Callable[[float], float]  # seconds to go on for -> env steps/s


def bare_sampled(copies: int, number: int) -> Loop:
    """Random actions as the field takes them."""
    envs = [gymnasium.make(ENV.id) for _ in range(copies)]
    for seed, env in enumerate(envs, start=number * copies):
        env.reset(seed=seed)
        env.action_space.seed(seed)

    def loop(seconds: float) -> float:
        steps, start = 0, time.perf_counter()
        while (now := time.perf_counter()) - start < seconds:
            for env in envs:
                _, _, terminated, truncated, _ = env.step(env.action_space.sample())
                if terminated or truncated:
                    env.reset()
            steps += copies
        return steps / (now - start)

    return loop


def bare_drawn(copies: int, number: int) -> Loop:
    """The fastest bare loop: no checker, actions drawn beforehand."""
    envs = [ENV.make() for _ in range(copies)]
    for seed, env in enumerate(envs, start=number * copies):
        env.reset(seed=seed)
    rows = np.random.default_rng(number).integers(2, size=(1000, copies))

    def loop(seconds: float) -> float:
        steps, start = 0, time.perf_counter()
        while (now := time.perf_counter()) - start < seconds:
            for env, action in zip(envs, rows[steps // copies % len(rows)], strict=True):
                _, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    env.reset()
            steps += copies
        return steps / (now - start)

    return loop


def ours(lanes: int, copies: int, number: int) -> Loop:
    """The collector over `lanes` lanes that share the copies."""
    run = RunSpec(ENV, POLICY, rollout_steps=STEPS, copies=copies // lanes, lanes=PROCESSES * lanes, seed=1)
    collector = Collector(run, NumpyPolicy(POLICY))
    parameters = 0.01 * np.random.default_rng(0).standard_normal(size(layout(POLICY)[0]), np.float32)
    collector.load(parameters, np.zeros(buffer_size(POLICY), np.float32))
    mine = range(number * lanes, (number + 1) * lanes)
    sequence = 0

    def loop(seconds: float) -> float:
        nonlocal sequence
        steps, start = collector.steps, time.perf_counter()
        while (now := time.perf_counter()) - start < seconds:
            collector.collect([Assignment(0, lane, 0, sequence) for lane in mine], 0, 0, _no_pulse)
            sequence += 1
        return (collector.steps - steps) / (now - start)

    return loop


def _no_pulse() -> None: ...


CONTENDERS = ("bare, sampled", "bare, drawn", "ours, 2 lanes", "ours, 1 lane")


def _make(name: str, copies: int, number: int) -> Loop:
    match name:
        case "bare, sampled":
            return bare_sampled(copies, number)
        case "bare, drawn":
            return bare_drawn(copies, number)
        case _:
            return ours(int(name.split()[1]), copies, number)


def _process(name: str, copies: int, number: int, pipe: Connection) -> None:
    """Step for as long as is asked, each time it is asked."""
    loop = _make(name, copies, number)
    while (seconds := pipe.recv()) is not None:
        pipe.send(loop(seconds))


class Pair:
    """Two processes that do the same at the same time."""

    def __init__(self, name: str, copies: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipes = []
        self._processes = []
        for number in range(PROCESSES):
            here, there = context.Pipe()
            process = context.Process(target=_process, args=(name, copies, number, there), daemon=True)
            process.start()
            self._pipes.append(here)
            self._processes.append(process)

    def rate(self, seconds: float) -> float:
        """Env steps/s of both together."""
        for pipe in self._pipes:
            pipe.send(seconds)
        return float(sum(pipe.recv() for pipe in self._pipes))

    def close(self) -> None:
        for pipe in self._pipes:
            pipe.send(None)
        for process in self._processes:
            process.join()


def collecting(copies: int, rounds: int, seconds: float) -> list[dict[str, object]]:
    """A row for each contender, with `copies` in each process: its rate and its share of the sampled bare loop."""
    pairs = {name: Pair(name, copies) for name in CONTENDERS}
    for pair in pairs.values():
        pair.rate(0.2)  # warm up
    turns = [{name: pair.rate(seconds) for name, pair in pairs.items()} for _ in range(rounds)]
    for pair in pairs.values():
        pair.close()
    return [
        {
            "copies_each": copies,
            "contender": name,
            "env_steps_per_s": round(statistics.median(turn[name] for turn in turns)),
            "share_of_sampled": statistics.median(turn[name] / turn["bare, sampled"] for turn in turns),
            "share_of_drawn": statistics.median(turn[name] / turn["bare, drawn"] for turn in turns),
            "target": TARGETS[copies] if name.startswith("ours") else None,
        }
        for name in CONTENDERS
    ]


def show(rows: list[dict[str, object]]) -> Table:
    table = Table(title=f"Collecting {ENV.id}, {PROCESSES} processes, T = {STEPS}")
    for column in ("copies each", "", "env steps/s", "of sampled", "of drawn", "target"):
        table.add_column(column, justify="left" if column == "" else "right")
    for row in rows:
        shares = [f"{row[name]:.2f}" for name in ("share_of_sampled", "share_of_drawn")]
        target = f"≥ {row['target']}" if row["target"] else ""
        table.add_row(str(row["copies_each"]), str(row["contender"]), f"{row['env_steps_per_s']:,}", *shares, target)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description="collecting in two processes against the bare loop")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each turn")
    arguments = parser.parse_args()
    rows = [row for copies in TARGETS for row in collecting(copies, arguments.rounds, arguments.seconds)]
    Console().print(show(rows))
    # What belongs to a real worker process (resident memory, time from exec to first rollout) is another section here.
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "collect.json").write_text(json.dumps({"collecting": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
