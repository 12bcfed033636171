"""SAC and TD3 on Pendulum-v1 with Stable-Baselines3's hyperparameters: `python -m benchmarks.continuous`.

Rule: both systems use the same networks, batch size, replay buffer, learning rates and replay ratio (1), and one env copy.
Stable-Baselines3 takes a gradient step after each env step. millrace takes 8 gradient steps after every 8 env steps, in the
learner, while one worker process collects.

Env steps/s are measured after `learning_starts`. The time to -200 is measured from the start of the command (with imports
and evaluations) until the mean return of a greedy evaluation reaches -200. There is an evaluation of 10 episodes every 1,000
env steps. The share of the arithmetic is the time that the matrix products of a gradient step alone take, divided by the
time of an env step.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import math
import statistics
import time
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks.programs import Contender, run
from benchmarks.writing import write

OURS = "millrace"
OVERLAPPED = "millrace, --max-lag 1"
THEIRS = "SB3"
CONTENDERS = {
    OURS: Contender("millrace", flags=("--workers", "1", "--lanes", "1")),
    OVERLAPPED: Contender("millrace", flags=("--workers", "1", "--lanes", "1", "--max-lag", "1")),
    THEIRS: Contender("benchmarks.train_stable_baselines3", "one"),
}
COMMON: dict[str, Any] = {
    "env": "Pendulum-v1", "envs": 1, "rollout_steps": 8, "batch_size": 256, "gamma": 0.99, "tau": 0.005,
    "learning_rate": 1e-3, "learning_starts": 100, "replay_size": 50_000, "eval_every": 1000, "eval_episodes": 10,
}  # fmt: skip
ROWS = 256
OBSERVATION = 3
ACTION = 1
WARM_UP_STEPS = 600  # number of env steps that aren't counted
SOLVED = -200.0
LONGEST = 20_000


def products_s(algo: str, width: int, repeats: int = 200) -> float:
    """Seconds that the matrix products of one gradient step take, with networks of two hidden layers of this width."""

    def seconds(n: int, k: int, m: int) -> float:
        a = torch.randn(n, k)
        b = torch.randn(k, m)
        out = torch.empty(n, m)
        found = []
        for _ in range(repeats):
            began_s = time.perf_counter()
            torch.mm(a, b, out=out)
            found.append(time.perf_counter() - began_s)
        return statistics.median(found)

    hidden = seconds(width, width, ROWS)
    first = seconds(width, OBSERVATION + ACTION, ROWS)
    # A pass is either forward, backward for the weights or backward for the inputs, through one network. The targets need 3
    # forward passes (the actor and 2 critics). The critics' loss needs all three kinds of 2 critics. The actor's loss in SAC
    # needs a forward pass of the actor, 2 forward passes of the critics, 2 backward passes for the critics' inputs, and 2
    # backward passes of the actor. In TD3 it is computed in every second step, with one critic.
    passes = 3 + 2 + 4 + (1 + 2 + 2 + 2 if algo == "sac" else (1 + 1 + 1 + 2) / 2)
    return passes * (hidden + first)


def rate(name: str, settings: dict[str, Any], steps: int, seed: int) -> float:
    """Env steps/s after the warm-up."""
    done = run(name, settings | {"steps": steps, "seed": seed}, contender=CONTENDERS[name])
    return done.steps_per_s(after_steps=WARM_UP_STEPS)


def seconds_to_solve(name: str, settings: dict[str, Any], seed: int) -> float:
    """Seconds from the start of the command to a greedy evaluation of -200; NaN if the run didn't reach it."""
    return run(name, settings | {"steps": LONGEST, "seed": seed}, SOLVED, contender=CONTENDERS[name]).solved_s


def main() -> None:
    parser = argparse.ArgumentParser(description="compare SAC and TD3 on Pendulum-v1 with Stable-Baselines3")
    parser.add_argument("--rounds", type=int, default=3, help="number of turns, each with another seed")
    parser.add_argument("--steps", type=int, default=3000, help="env steps of a run whose rate is measured")
    parser.add_argument("--algo", nargs="+", default=["sac", "td3"], choices=["sac", "td3"])
    parser.add_argument("--no-solve", action="store_true", help="leave out the time to -200")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    kinds = [(algo, width) for algo in arguments.algo for width in (64, 256)]
    found: dict[tuple[str, str], list[float]] = {}
    for seed in range(1, arguments.rounds + 1):
        for name in CONTENDERS if seed % 2 else reversed(CONTENDERS):
            for algo, width in kinds:
                settings = COMMON | {"algo": algo, "net": [width, width]}
                found.setdefault((f"{algo} {width}", name), []).append(rate(name, settings, arguments.steps, seed))
                if algo == "sac" and not arguments.no_solve:
                    found.setdefault((f"seconds to -200, {width}", name), []).append(seconds_to_solve(name, settings, seed))
    table = Table("", "contender", "median", "all turns", "ratio to SB3", "share of the arithmetic")
    rows = []
    for (what, name), numbers in sorted(found.items()):
        ratio = statistics.median(our / its for our, its in zip(numbers, found[what, THEIRS], strict=True))
        median = statistics.median(math.inf if math.isnan(number) else number for number in numbers)
        algo, _, size = what.partition(" ")
        share = products_s(algo, int(size)) * median if algo in arguments.algo else math.nan
        rows.append({"what": what, "contender": name, "median": median, "turns": numbers, "ratio": ratio, "share": share})
        places = 0 if median > 100 else 1
        turns = ", ".join(f"{number:,.{places}f}" for number in numbers)
        table.add_row(
            what, name, f"{median:,.{places}f}", turns, f"{ratio:.2f}", "" if math.isnan(share) else f"{share:.2f}"
        )
    Console(width=120).print(table)
    write("continuous", {"settings": COMMON, "rows": [{k: v for k, v in row.items() if v == v} for row in rows]})


if __name__ == "__main__":
    main()
