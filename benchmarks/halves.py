"""Simulates acting on a GPU with `--inference learner`: `python -m benchmarks.halves`. It needs no GPU, and measures none.

Sixteen workers step 128 copies, whose steps sleep, and the policy sleeps for as long as a pass on the device would take.
Neither competes for this machine's cores, just as on a machine with sixteen cores and a GPU. The lanes are stepped in one
part or in two. With two parts, the policy acts for one half of the copies while the other half steps. `benchmarks.gpu`
measures how long a step and a pass take on a real machine; here both times are given, and the observations are small.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import statistics
import tempfile
import time
from collections.abc import Sequence
from typing import Any
from unittest.mock import patch

from rich.console import Console
from rich.table import Table

from benchmarks.writing import write
from millrace.launch import learner_inference
from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.policy.policy import Policy
from millrace.workers.copies.split_vector_env import SplitVectorEnv

WORKERS = 16
LANES = 32  # two for each worker, one in each half
COPIES = 128
STEPS = 64  # number of steps in a rollout
UPDATES = 8
WARM_UP = 3  # updates that are not counted
ENV = "benchmarks.slow_env:Constant-v0"
PASS_S = (0.5e-3, 1e-3, 2e-3)  # time of a pass, whatever its size
COPY_S = 4e-6  # additional time of a pass for each copy
STEP_S = 0.27e-3  # time of a step of Pong on one core


class Device:
    """Wraps a policy and returns the same actions, but takes as long as a policy on a device would."""

    def __init__(self, policy: Policy, pass_s: float) -> None:
        self._policy = policy
        self._pass_s = pass_s

    def load(self, parameters: Floats, buffers: Floats) -> None:
        self._policy.load(parameters, buffers)

    def __call__(self, obs: Sequence[Array], state: Floats) -> Floats:
        time.sleep(self._pass_s + COPY_S * obs[0].shape[0] * obs[0].shape[1])
        return self._policy(obs, state)


def rate(parts: int, pass_s: float) -> float:
    """Env steps/s while the learner waits for rollouts."""
    waits: list[tuple[int, float]] = []  # env steps and seconds waited, after each update

    def watch(progress: Progress) -> None:
        waits.append((progress.env_steps, progress.stages["learner_wait"]))

    own_policy = learner_inference.acting_policy
    own_init = SplitVectorEnv.__init__

    def slow_policy(*arguments: Any) -> Device:
        return Device(own_policy(*arguments), pass_s)

    def in_parts(self: SplitVectorEnv, *arguments: Any, **others: Any) -> None:
        own_init(self, *arguments, **others)
        self.in_parts = parts

    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(learner_inference, "acting_policy", slow_policy),
        patch.object(SplitVectorEnv, "__init__", in_parts),
    ):
        config = resolve(
            ENV,
            preset="none",
            env_kwargs={"seconds": STEP_S, "steps": 1_000_000},
            inference="learner",
            workers=WORKERS,
            lanes=LANES,
            envs=COPIES,
            rollout_steps=STEPS,
            batch_size=COPIES * STEPS,
            n_epochs=1,
            steps=UPDATES * COPIES * STEPS,
            eval_episodes=1,
            eval_max_steps=1,
            run_dir=folder,
        )
        train(config, None, watch)
    (steps, wait_s), (last_steps, last_wait_s) = waits[WARM_UP], waits[-1]
    return (last_steps - steps) / (last_wait_s - wait_s)


def main() -> None:
    parser = argparse.ArgumentParser(description="simulate acting on a GPU, for all copies at once and in two halves")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    table = Table(title=f"env steps/s with a simulated device, medians of {arguments.rounds}")
    for column in ("ms of a pass", "all at once", "two halves", "ratio"):
        table.add_column(column, justify="right")
    found = []
    for pass_s in PASS_S:
        rounds = [[rate(parts, pass_s) for parts in (1, 2)] for _ in range(arguments.rounds)]
        one, two = (statistics.median(each) for each in zip(*rounds, strict=True))
        ratio = statistics.median(halves / whole for whole, halves in rounds)
        found.append({"pass_s": pass_s, "at_once": round(one), "halves": round(two), "ratio": round(ratio, 2)})
        table.add_row(f"{1e3 * pass_s:g}", f"{one:,.0f}", f"{two:,.0f}", f"{ratio:.2f}")
    Console().print(table)
    write("halves", {"halves": found}, [])


if __name__ == "__main__":
    main()
