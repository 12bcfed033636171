"""Measures the parts of training from frames on this machine: `python -m benchmarks.gpu`, or `millrace bench gpu`.

It runs PPO with the settings for Atari, on frames of 84 × 84 × 4 bytes from an environment that takes as much time as an
emulator (`benchmarks/frames.py`). It is meant for a machine with a GPU and many cores, where it takes ten minutes, and shows
which part is the bottleneck: collecting with 1, 8, 12 and 16 workers (as far as there are cores), stacking a batch, copying
it to the device, the update, or publishing weights. Then it trains and compares the time of an update with the sum of the
parts: a difference is time that is lost elsewhere. On a machine without a GPU, the device is the CPU.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

import millrace
from benchmarks.writing import processor, write
from millrace.launch.training import train
from millrace.learner.config.config import TABLES, Config
from millrace.learner.config.layers import resolve
from millrace.learner.config.presets import environment_presets
from millrace.learner.run_folder.metrics_log import METRICS_FILE, read_rows
from millrace.learner.torch_setup import torch_device
from millrace.learner.update_time import update_time
from millrace.protocol.arrays import Floats
from millrace.protocol.machine.cpu_cores import usable_cores
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec

ENV = "benchmarks.frames:Frames-v0"
ATARI = "millrace/Atari-v0"
WORKERS = (1, 8, 12, 16)
COPIES = 4  # number of env copies in a worker
STEPS = 128  # number of steps in a rollout
WARM_UP = 2  # number of batches, or updates, that aren't counted
REPEATS = 5
LAGS = (0, 1)


class Parts(NamedTuple):
    """Seconds that each part of an update takes, for a batch of `env_steps` env steps."""

    env_steps: int
    collect_s: float
    stack_s: float
    copy_s: float
    update_s: float
    publish_s: float

    @property
    def in_turn_s(self) -> float:
        """The time of an update if workers and learner take turns. Stacking is a part of collecting."""
        return self.collect_s + self.copy_s + self.update_s + self.publish_s


def settings(workers: int, **others: Any) -> Config:
    """The settings of the preset for Atari, with this number of workers. `others`: further settings."""
    of_atari = {name: value for name, value in environment_presets("ppo")[ATARI].items() if name not in TABLES}
    sizes = {"workers": workers, "lanes": workers, "envs": COPIES * workers, "rollout_steps": STEPS}
    return resolve(ENV, preset="none", **of_atari | sizes | others)


def numbers_of_workers(cores: int) -> list[int]:
    """The numbers of workers to measure: those in `WORKERS` for which there are cores, and the number of cores."""
    return sorted({*(each for each in WORKERS if each <= cores), cores})


def median_s(call: Callable[[], object]) -> float:
    """Median seconds of a call, including the time until the device has finished."""
    taken = []
    for _ in range(REPEATS):
        began_s = time.perf_counter()
        call()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        taken.append(time.perf_counter() - began_s)
    return statistics.median(taken)


class Collected(NamedTuple):
    """The times of collecting a batch and of publishing weights, with the last batch."""

    collect_s: float
    publish_s: float
    batch: Batch
    policy: PolicySpec


def collected(workers: int, seconds: float) -> Collected:
    """Collect batches for this many seconds. Returns median times."""
    config = settings(workers)
    with millrace.RolloutService(
        ENV, millrace.CNN(), workers=workers, lanes=config.lanes, envs=config.envs, rollout_steps=STEPS
    ) as service:
        parameters = service.policy.initial(seed=1)
        collect_s: list[float] = []
        publish_s: list[float] = []
        end_s = time.monotonic() + seconds
        while len(collect_s) < WARM_UP + REPEATS or time.monotonic() < end_s:
            began_s = time.perf_counter()
            service.publish(parameters)
            published_s = time.perf_counter()
            batch = service.gather()
            publish_s.append(published_s - began_s)
            collect_s.append(time.perf_counter() - published_s)
        return Collected(
            statistics.median(collect_s[WARM_UP:]), statistics.median(publish_s[WARM_UP:]), batch, service.run.policy
        )


def parts(workers: int, seconds: float) -> Parts:
    """Measure each part of an update with this number of workers."""
    collect_s, publish_s, batch, policy = collected(workers, seconds)
    config = settings(workers)
    device = torch_device(config)
    frames = batch.obs
    of_lanes = np.split(frames, workers, axis=1)

    def collect(parameters: Floats, buffers: Floats) -> Batch:
        return msgspec.structs.replace(batch, obs=(frames,))

    update = update_time(config, policy, collect, seconds, workers)
    return Parts(
        env_steps=batch.env_steps,
        collect_s=collect_s,
        stack_s=median_s(lambda: np.concatenate(of_lanes, axis=1)),
        copy_s=median_s(lambda: torch.from_numpy(frames).to(device)) if device != "cpu" else 0.0,
        update_s=update.per_step_s * batch.env_steps,
        publish_s=publish_s,
    )


def trained(workers: int, lag: int, updates: int) -> float:
    """Median seconds of an update in a whole training run, leaving out the first updates."""
    with tempfile.TemporaryDirectory() as folder:
        config = settings(
            workers,
            max_lag=lag,
            steps=updates * COPIES * workers * STEPS,
            eval_episodes=1,
            eval_max_steps=1,
            run_dir=folder,
            checkpoint_every_s=1e9,
        )
        rows = read_rows(train(config, None, lambda progress: None) / METRICS_FILE)
    at_s = [row["time/time_elapsed"] for row in rows]
    return float(np.median(np.diff(at_s)[WARM_UP:]))


def main() -> None:
    parser = argparse.ArgumentParser(description="measure training from frames by its parts")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long each part is measured")
    parser.add_argument("--updates", type=int, default=20, help="number of updates of each run")
    arguments = parser.parse_args()
    cores = usable_cores()
    device = torch_device(settings(1))
    where = torch.cuda.get_device_name() if device == "cuda" else "no GPU"
    table = Table(title=f"milliseconds of an update, {where}, {cores} cores ({processor()})")
    for column in ("workers", "batch", "collect", "stack", "copy", "update", "publish", "in turn", "lag 0", "lag 1"):
        table.add_column(column, justify="right")
    found: dict[str, Any] = {}
    for workers in numbers_of_workers(cores):
        of_parts = parts(workers, arguments.seconds)
        of_runs = [trained(workers, lag, arguments.updates) for lag in LAGS]
        found[str(workers)] = {
            **of_parts._asdict(),
            **{f"lag_{lag}_s": each for lag, each in zip(LAGS, of_runs, strict=True)},
        }
        table.add_row(
            str(workers),
            f"{of_parts.env_steps:,}",
            *(f"{1e3 * each:,.1f}" for each in of_parts[1:]),
            f"{of_parts.env_steps / of_parts.in_turn_s:,.0f}",
            *(f"{of_parts.env_steps / each:,.0f}" for each in of_runs),
        )
    console = Console(width=130)
    console.print(table)
    console.print(
        "In turn: env steps/s by the sum of collect, copy, update and publish; stacking is a part of collecting. What lag 0 "
        "is slower than this is lost outside of the parts. Lag 1 is limited by the longer of collecting and the rest."
    )
    write("gpu", found, [])


if __name__ == "__main__":
    main()
