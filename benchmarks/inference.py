"""Compares `--inference workers` with `--inference learner`: `python -m benchmarks.inference`.

It trains PPO in both modes, in turns. It measures the memory of a worker, and env steps/s of two workers while the learner
waits for rollouts, which leaves out updates. The machine need not be idle, because the two modes are compared within a
round.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import statistics
import tempfile
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from benchmarks.writing import write
from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.env_spec import EnvSpec

WARM_UP = 2  # number of updates that aren't counted, because env copies are made and torch is imported during them
MODES = ("workers", "learner")


class Frames(gymnasium.Env[Any, Any]):
    """An environment with frames of 84×84×4 uint8, which change in every step and take almost no time."""

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(0, 255, (84, 84, 4), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(6)
        self._frame = np.zeros((84, 84, 4), np.uint8)
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self._frame.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        self._frame[self._steps % 84] += 1
        return self._frame.copy(), 1.0, self._steps == 500, False, {}


CASES: dict[str, tuple[Callable[..., object] | None, dict[str, Any]]] = {
    "CartPole-v1, 8 copies": (None, {"envs": 8, "rollout_steps": 256, "n_epochs": 1, "steps": 40_000}),
    "CartPole-v1, 64 copies": (
        None,
        {"envs": 64, "rollout_steps": 256, "n_epochs": 1, "batch_size": 2048, "steps": 300_000},
    ),
    "84×84×4, 16 copies": (Frames, {"envs": 16, "rollout_steps": 16, "n_epochs": 1, "batch_size": 256, "steps": 2_600}),
}


def measure(case: str, mode: str, threads: int) -> tuple[float, float]:
    """Env steps/s while the learner waits for rollouts, and the memory of one worker in MB."""
    factory, settings = CASES[case]
    waits: list[tuple[int, float]] = []  # env steps and seconds waited, after each update
    memory: list[float] = []

    def watch(progress: Progress) -> None:
        waits.append((progress.env_steps, progress.stages["learner_wait"]))
        workers = [child for child in psutil.Process().children() if "millrace.workers" in child.cmdline()]
        memory.extend(worker.memory_info().rss / 1e6 for worker in workers)

    with tempfile.TemporaryDirectory() as folder:
        config = resolve(
            "CartPole-v1" if factory is None else "Frames",
            inference=mode,
            torch_threads=threads,
            eval_episodes=1,
            run_dir=folder,
            **settings,
        )
        train(config, None, watch, None if factory is None else EnvSpec.of(factory))
    (steps, wait_s), (last_steps, last_wait_s) = waits[WARM_UP], waits[-1]
    return (last_steps - steps) / (last_wait_s - wait_s), statistics.median(memory)


def main() -> None:
    parser = argparse.ArgumentParser(description="compare --inference workers with --inference learner")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--torch-threads", type=int, default=2, help="torch threads of the learner; each worker has one")
    arguments = parser.parse_args()
    rows: list[dict[str, object]] = []
    for case in CASES:
        rounds = [{mode: measure(case, mode, arguments.torch_threads) for mode in MODES} for _ in range(arguments.rounds)]
        for mode in MODES:
            rate, memory = (statistics.median(measured[mode][i] for measured in rounds) for i in range(2))
            rows.append({"case": case, "inference": mode, "env_steps_per_s": round(rate), "worker_mb": round(memory)})
    table = Table(title=f"PPO on two workers, collecting, medians of {arguments.rounds}")
    for column in rows[0]:
        table.add_column(column)
    for row in rows:
        table.add_row(*map(str, row.values()))
    Console().print(table)
    write("inference", {"inference": rows})


if __name__ == "__main__":
    main()
