"""Rates: env steps/s of a program whose steps take a given time. They are kept in benchmarks/rates.json.

Rule: a rate is measured after the warm-up, over whole updates with their gradient steps. Rates at other step times are
computed from the measured one. If env copies wait for updates, the time of an env step is its share of the updates plus its
share of the step time. If copies step during updates, the slower of the two determines the rate.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from benchmarks import kept_records
from benchmarks.programs import OUTPUT, started
from benchmarks.wall_clock_programs import COPIES, OURS, Program, rate_command
from millrace.learner.run_folder.metrics_log import METRICS_FILE, read_rows

RATES = Path(__file__).with_name("rates.json")
LOOK_S = 0.5
LONGEST_S = 600.0
LEAST_UPDATES = 2
"""minimum number of updates over which a rate is measured"""


class Rate(msgspec.Struct, kw_only=True):
    """The rate of a program on one environment, at one step time."""

    env: str
    system: str
    algo: str
    step_s: float
    processor: str
    command: str
    """the command of each round, with S in place of the seed"""
    rates: list[float]
    """env steps/s of each round"""

    @property
    def key(self) -> tuple[str, str, str, float, str]:
        """The fields that identify the rate: a newer rate with the same key replaces it."""
        return self.env, self.system, self.algo, self.step_s, self.processor

    @property
    def median(self) -> float:
        """The median env steps/s over the rounds."""
        return statistics.median(self.rates)


class RateAt(NamedTuple):
    """Env steps/s at a step time."""

    per_s: float
    computed: bool
    """whether it was computed from the rate at another step time"""


def read_rates() -> list[Rate]:
    """Read the kept rates."""
    return kept_records.read(RATES, Rate)


def write_rates(rates: Iterable[Rate]) -> None:
    """Write these rates to the file of kept rates."""
    kept_records.write(RATES, rates)


def rate_at(step_s: float, rates: Sequence[Rate]) -> RateAt | None:
    """The rate of a program at a step time, from its measured rates; None if there are none.

    If it wasn't measured, it is computed from the nearest shorter step time. At longer step times, updates are a smaller
    part of the time, so their duration is known less precisely.
    """
    if not rates:
        return None
    ordered = sorted(rates, key=lambda rate: rate.step_s)
    base = next((rate for rate in reversed(ordered) if rate.step_s <= step_s), ordered[0])
    return RateAt(base.median, False) if base.step_s == step_s else RateAt(computed(step_s, base), True)


def computed(step_s: float, base: Rate) -> float:
    """The rate at a step time, computed from the rate `base` at another one."""
    if Program(base.system, base.algo).overlaps:
        return min(base.median, COPIES / step_s)
    of_updates_s = max(0.0, 1 / base.median - base.step_s / COPIES)
    return 1 / (of_updates_s + step_s / COPIES)


def largest_error(rates: Iterable[Rate]) -> float | None:
    """The largest relative error of computed rates, compared with measured ones; None if no program has two step times."""
    of: dict[tuple[str, ...], list[Rate]] = {}
    for rate in sorted(rates, key=lambda rate: rate.step_s):
        of.setdefault((rate.env, rate.system, rate.algo, rate.processor), []).append(rate)
    errors = [abs(computed(long.step_s, first) / long.median - 1) for first, *longer in of.values() for long in longer]
    return max(errors, default=None)


def can_be_measured(program: Program, env: str, step_s: float, seconds: float) -> bool:
    """Whether the env steps between two updates take no longer than the measurement."""
    return program.steps_of_an_update(env) / COPIES * step_s <= seconds


def measure(
    program: Program, env: str, step_s: float, seed: int, *, seconds: float, threads: int = 1, device: str = "cpu"
) -> float:
    """Measure env steps/s over at least this many seconds after the warm-up. Raises `RuntimeError` if the run fails."""
    command = rate_command(program, env, step_s, seed, threads, device)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        began_s = time.monotonic()
        with started(command, folder) as process:
            try:
                while True:
                    found = rate_of(updates(program, folder), program.warm_up_steps(env), seconds)
                    if found is not None:
                        return found
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(LOOK_S)
                    if process.returncode is not None or time.monotonic() - began_s > LONGEST_S + seconds:
                        said = (folder / OUTPUT).read_text()[-500:]
                        raise RuntimeError(f"{program.system}, {program.algo}, {env}: no rate was found: {said}")
            finally:
                process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(10)


def updates(program: Program, folder: Path) -> list[tuple[int, float]]:
    """The env steps and the time in seconds at the end of each update of the run in this folder."""
    if program.system == OURS:
        return [
            (int(row["time/total_timesteps"]), row["time/time_elapsed"])
            for table in folder.rglob(METRICS_FILE)
            for row in read_rows(table)
        ]
    *lines, _ = (folder / OUTPUT).read_text().split("\n")
    read = [json.loads(line) for line in lines if line.startswith('{"env_steps"')]
    return [(line["env_steps"], line["at_s"]) for line in read]


def rate_of(found: Sequence[tuple[int, float]], warm_up_steps: int, seconds: float) -> float | None:
    """Env steps/s between the first update after the warm-up and the last one; None if they aren't far enough apart yet."""
    counted = [update for update in found if update[0] >= warm_up_steps]
    if len(counted) <= LEAST_UPDATES:
        return None
    (first, began_s), (last, ended_s) = counted[0], counted[-1]
    return (last - first) / (ended_s - began_s) if ended_s - began_s >= seconds else None
