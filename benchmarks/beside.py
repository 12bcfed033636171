"""Compares the speed of training without evaluations, with ones that it waits for, and with ones that run alongside.

`python -m benchmarks.beside`, or for one algorithm with `--algo sac`. A step of the environment sleeps for 50 ms, so that
the number of cores doesn't matter. Four workers train, with one env copy each. An evaluation is four episodes of eight steps
on one worker. An evaluation is due whenever training has lasted twice as long as an evaluation, so evaluations take a third
of the time if training waits for them. The rate is env steps/s between the first counted update and the last, including
evaluations. All contenders take turns.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from typing import Any

import millrace
from benchmarks.writing import write

COPIES = 4
EPISODES = 4
EPISODE_STEPS = 8
# Env steps that training takes in twice the time of an evaluation, whose env copies share a worker.
EVERY = 2 * EPISODES * EPISODE_STEPS * COPIES
WARM_UP_STEPS = 2 * COPIES * 16
SETTINGS: dict[str, Any] = {
    "env": "benchmarks.slow_env:FiftyMilliseconds-v0",
    "workers": COPIES, "lanes": COPIES, "envs": COPIES, "preset": "none", "progress": False, "net": (32, 32),
    "eval_episodes": EPISODES, "eval_copies": EPISODES, "eval_max_steps": EPISODES * EPISODE_STEPS,
}  # fmt: skip
ALGORITHMS: dict[str, dict[str, Any]] = {
    "ppo": {"rollout_steps": 16, "n_epochs": 2},
    "sac": {"rollout_steps": 16, "learning_starts": 0, "batch_size": 32},
}
CONTENDERS: dict[str, dict[str, Any]] = {
    "none": {"eval_every": 0},
    "training waits": {"eval_every": EVERY},
    "beside training": {"eval_every": EVERY, "eval_workers": 1},
}


def rate(algo: str, contender: str, steps: int, seed: int) -> float:
    """Env steps/s between the update after the warm-up and the last one."""
    moments: list[tuple[int, float]] = []

    def watch(progress: millrace.Progress) -> None:
        if progress.env_steps >= WARM_UP_STEPS and (not moments or progress.env_steps > moments[-1][0]):
            moments.append((progress.env_steps, time.monotonic()))

    with tempfile.TemporaryDirectory() as folder:
        settings = {**SETTINGS, **ALGORITHMS[algo], **CONTENDERS[contender], "algo": algo, "steps": steps, "seed": seed}
        millrace.train(**settings, run_dir=folder, callbacks=[watch])
    (first, began_s), (last, ended_s) = moments[0], moments[-1]
    return (last - first) / (ended_s - began_s)


def main() -> int:
    """Measure, print a table, and write it to benchmarks/results."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--algo", choices=sorted(ALGORITHMS), action="append")
    parser.add_argument("--steps", type=int, default=2_560)
    parser.add_argument("--rounds", type=int, default=3)
    flags = parser.parse_args()
    found: dict[str, dict[str, list[float]]] = {}
    for algo in flags.algo or sorted(ALGORITHMS):
        of_algo = found[algo] = {contender: [] for contender in CONTENDERS}
        for seed in range(1, flags.rounds + 1):
            for contender in CONTENDERS:
                of_algo[contender].append(rate(algo, contender, flags.steps, seed))
        without = statistics.median(of_algo["none"])
        for contender, rates in of_algo.items():
            median = statistics.median(rates)
            sys.stdout.write(f"{algo}, evaluations: {contender:16} {median:6.1f} env steps/s, {median / without:.2f}\n")
            sys.stdout.flush()
    write("beside", found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
