"""Rows/s of multi-agent vector environments under random actions: `python -m benchmarks.seats`.

Each env copy has 16 agents, which all act in an episode of 100 steps. A step takes little time, or sleeps for 1 ms. A row is
a step of one agent. The contenders are the vector environments of millrace, PufferLib and supersuit (if installed), with the
same number of processes, and a plain loop over the copies in this process, which stores nothing. In each round each
contender is made, run and closed once, in an order that changes from round to round. Rates are medians over rounds; ratios
are computed within a round.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import statistics
import time
import warnings
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from rich.console import Console
from rich.table import Table

import millrace

AGENTS = [f"agent_{number}" for number in range(16)]
LENGTH = 100  # number of steps in an episode


class Team(ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """An environment with 16 agents, whose step takes little time or sleeps."""

    metadata: dict[str, Any] = {"name": "team"}
    render_mode = None
    possible_agents = AGENTS

    def __init__(self, seconds: float = 0.0) -> None:
        self._seconds = seconds
        self._none = dict.fromkeys(AGENTS, False)
        self._space = spaces.Box(-1, 1, (8,), np.float32)
        self._actions = spaces.Discrete(4)
        self._seen = np.zeros((len(AGENTS), 8), np.float32)

    def observation_space(self, agent: str) -> spaces.Box:
        return self._space

    def action_space(self, agent: str) -> spaces.Discrete:
        return self._actions

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.agents = [*AGENTS]
        self._left = LENGTH
        return dict(zip(AGENTS, self._seen, strict=True)), {agent: {} for agent in AGENTS}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        if self._seconds:
            time.sleep(self._seconds)
        self._left -= 1
        over = self._none if self._left else dict.fromkeys(AGENTS, True)
        self.agents = self.agents if self._left else []
        seen = dict(zip(AGENTS, self._seen, strict=True))
        return seen, dict.fromkeys(AGENTS, 1.0), self._none, over, {agent: {} for agent in AGENTS}


class Task(NamedTuple):
    """The env copies to step, and the processes that step them."""

    title: str
    copies: int
    workers: int
    seconds: float = 0.0


class Loop:
    """A plain loop over the copies."""

    def __init__(self, task: Task) -> None:
        self._envs = [Team(task.seconds) for _ in range(task.copies)]
        for env in self._envs:
            env.reset()

    def step(self, actions: Any) -> None:
        for env, row in zip(self._envs, actions.reshape(len(self._envs), -1), strict=True):
            env.step(dict(zip(AGENTS, row, strict=True)))
            if not env.agents:
                env.reset()


def step_function(name: str, task: Task) -> tuple[Callable[[Any], object], Callable[[], None]]:
    """Make a contender. Returns a function that steps all copies with an array of actions, and one that closes them.

    Raises `ImportError` if the contender isn't installed.
    """
    make = partial(Team, task.seconds)
    match name:
        case "plain loop":
            return Loop(task).step, lambda: None
        case "PufferLib":
            puffer = import_module("pufferlib.emulation")
            vector = import_module("pufferlib.vector")
            made = vector.make(
                partial(wrapped, puffer.PettingZooPufferEnv, make),
                backend=vector.Multiprocessing, num_envs=task.copies, num_workers=task.workers, overwork=True,
            )  # fmt: skip
            made.reset(seed=1)
            return made.step, made.close
        case "supersuit":
            supersuit = import_module("supersuit")
            made = supersuit.concat_vec_envs_v1(supersuit.pettingzoo_env_to_vec_env_v1(make()), task.copies, task.workers)
            made.reset(seed=1)
            return made.step, made.close
        case _:
            made = millrace.make_vec(make, task.copies, workers=task.workers, shared_memory="messages" not in name)
            made.reset(seed=1)
            return made.step, made.close


def wrapped(kind: Any, make: Callable[[], Team], buf: Any = None, seed: int = 0) -> Any:
    """Make an env copy for PufferLib, which passes each copy its part of the arrays (`buf`)."""
    return kind(make(), buf=buf, seed=seed)


NAMES = ("plain loop", "supersuit", "PufferLib", "millrace", "millrace, messages")
TASKS = (
    Task("light", 8, 2),
    Task("light", 32, 2),
    Task("sleeps 1 ms a step", 8, 8, 0.001),
    Task("sleeps 1 ms a step", 8, 2, 0.001),
)


def rate(step: Callable[[Any], object], actions: Any, seconds: float) -> float:
    """Rows/s, measured over this time."""
    steps = 0
    start = time.perf_counter()
    while (now := time.perf_counter()) - start < seconds:
        step(actions[steps % len(actions)])
        steps += 1
    return float(steps * actions.shape[1] / (now - start))


def measure(task: Task, rounds: int, seconds: float, table: Table) -> None:
    """Measure a task, and add a row to the table for each contender."""
    actions = np.random.default_rng(1).integers(4, size=(100, task.copies * len(AGENTS)))
    present = [*NAMES]
    found: list[dict[str, float]] = []
    for number in range(rounds):
        found.append({})
        for name in present[number % len(present) :] + present[: number % len(present)]:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    step, close = step_function(name, task)
            except ImportError:
                present.remove(name)
                continue
            rate(step, actions, 0.3)
            found[-1][name] = rate(step, actions, seconds)
            close()  # because idle processes of PufferLib poll, and would slow down the next contender
    about = task.title, f"{task.copies} × {len(AGENTS)}", str(task.workers)
    for name in NAMES:
        if name not in present:
            table.add_row(*about, name, "not installed", "")
            continue
        rows = statistics.median(each[name] for each in found)
        ratio = statistics.median(each["millrace"] / each[name] for each in found)
        table.add_row(*about, name, f"{rows:,.0f}", f"{ratio:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description="vector environments of several agents under random actions")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each measurement")
    arguments = parser.parse_args()
    table = Table(title=f"random actions, medians of {arguments.rounds}")
    for column in ("task", "copies × agents", "processes", "", "rows/s", "millrace ÷ it"):
        table.add_column(column, justify="right" if column in ("rows/s", "millrace ÷ it") else "left")
    for task in TASKS:
        measure(task, arguments.rounds, arguments.seconds, table)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
