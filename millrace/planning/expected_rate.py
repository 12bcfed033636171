"""Predicts a run's env steps/s with a small queueing model. Pure.

A round is one rollout of each lane: T steps of all env copies. A worker steps the copies of its lanes one after another, so
its round takes T times the sum of their step times. A round of the run ends when the slowest worker's round ends; then the
learner updates the policy. With lag 0, collecting and updating take turns. With lag L, workers collect up to L rounds ahead.

Rule: all computation needs a core. A round never takes less than the CPU time used in it, divided by the number of cores.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from millrace.planning.measurements import Machine, Measurements, Overheads
from millrace.protocol.arrays import Doubles

ROUNDS = 60  # number of simulated rounds
WARM_UP = 10  # this many rounds at the beginning aren't counted
SHARPNESS = 4.0  # the larger, the closer `_larger` is to the maximum of two times


class Sizes(msgspec.Struct, frozen=True, kw_only=True):
    """The settings that determine how fast a run collects env steps."""

    workers: int
    envs: int
    lanes: int
    max_lag: int
    rollout_steps: int

    @property
    def most_lanes(self) -> int:
        """The largest number of lanes that a worker has."""
        return math.ceil(self.lanes / self.workers)

    @property
    def steps_per_round(self) -> int:
        """Steps of all env copies in a round."""
        return self.envs * self.rollout_steps


class Situation(msgspec.Struct, frozen=True, kw_only=True):
    """The measurements, and the machines on which the run will take place."""

    measured: Measurements
    overheads: Overheads
    machine: Machine
    machines: int = 1
    """number of machines that step env copies, all like this one; the learner runs on one of them"""
    resets_ahead: bool = False
    """whether copies are reset in the background, as with `millrace:ResetAhead`"""

    @property
    def cores(self) -> int:
        """Number of cores of all machines together."""
        return self.machine.cores * self.machines


class _RoundOfWorker(msgspec.Struct, frozen=True, kw_only=True):
    """The time that a worker needs for a round, if cores are free."""

    mean_s: float
    std_s: float
    cpu_s: float
    resets: float
    """mean number of resets in a round"""
    reset_s: float
    """time for which the worker waits in each reset"""


def steps_per_s(sizes: Sizes, situation: Situation, sampled: np.random.Generator) -> float:
    """The env steps/s to expect. `sampled`: generator for the times of rounds; the same seed gives the same result."""
    measured = situation.measured
    per_round = sizes.steps_per_round * _share_of_steps(measured)
    lanes_of = _lanes_of_workers(sizes)
    workers = {lanes: _worker(sizes, situation, lanes) for lanes in set(lanes_of)}
    of_round_s = situation.overheads.gathering_s(sizes.lanes, per_round)
    update_s = situation.overheads.update_s * per_round
    collecting_cpu_s = sum(workers[lanes].cpu_s for lanes in lanes_of)
    updating_cpu_s = of_round_s + update_s * max(1.0, situation.overheads.update_cores)
    times_s = np.stack([_times_of_rounds(workers[lanes], sampled) for lanes in lanes_of])  # [workers, ROUNDS]
    if sizes.max_lag == 0:
        collecting_s = float(times_s.max(axis=0)[WARM_UP:].mean())
        round_s = _larger(collecting_s, collecting_cpu_s / situation.cores) + of_round_s + update_s
    else:
        collecting_s = float(times_s.mean())
        stretched_s = _stretched_s(collecting_s, collecting_cpu_s / collecting_s, of_round_s + update_s, situation.cores)
        waiting_s = _round_with_lag_s(times_s, of_round_s + update_s, sizes.max_lag)
        round_s = max(stretched_s, _larger(waiting_s, (collecting_cpu_s + updating_cpu_s) / situation.cores))
    return per_round / round_s


def _share_of_steps(measured: Measurements) -> float:
    """The share of rows that are env steps: the row after the last step of an episode only resets the copy."""
    return measured.ends_every / (measured.ends_every + 1) if math.isfinite(measured.ends_every) else 1.0


def _lanes_of_workers(sizes: Sizes) -> list[int]:
    """How many lanes each worker has; workers without lanes are left out."""
    least, more = divmod(sizes.lanes, sizes.workers)
    return [lanes for lanes in [least + 1] * more + [least] * (sizes.workers - more) if lanes]


def _worker(sizes: Sizes, situation: Situation, lanes: int) -> _RoundOfWorker:
    measured = situation.measured
    costs = measured.costs(min(sizes.workers, sizes.lanes) // situation.machines)
    copies = lanes * sizes.envs // sizes.lanes
    rows = sizes.rollout_steps
    steps = rows * copies * _share_of_steps(measured)
    resets = rows * copies - steps
    reset_s = measured.reset_s
    if situation.resets_ahead:
        reset_s = max(measured.reset_cpu_s, reset_s - measured.ends_every * copies * costs.own_s)
    own_s = situation.overheads.worker_s(lanes, copies, rows)
    return _RoundOfWorker(
        mean_s=own_s + steps * costs.own_s,
        std_s=math.sqrt(steps) * costs.std_s,
        cpu_s=own_s + steps * costs.cpu_s + resets * measured.reset_cpu_s,
        resets=resets,
        reset_s=reset_s,
    )


def _times_of_rounds(worker: _RoundOfWorker, sampled: np.random.Generator) -> Doubles:
    """Sample how long a worker's rounds take: [ROUNDS] seconds."""
    steps_s = np.maximum(worker.mean_s / 2, sampled.normal(worker.mean_s, worker.std_s, ROUNDS))
    times_s: Doubles = steps_s + worker.reset_s * sampled.poisson(worker.resets, ROUNDS)
    return times_s


def _round_with_lag_s(times_s: Doubles, learner_s: float, max_lag: int) -> float:
    """Mean time of a round with lag `max_lag`.

    `times_s`: [workers, rounds], the time that each worker needs for each round. `learner_s`: the time of each update.
    """
    workers, rounds = times_s.shape
    ready_s = np.zeros(workers)  # when each worker finished its newest round
    updated_s: list[float] = []  # when each update ended
    for number in range(rounds):
        opened_s = updated_s[number - max_lag - 1] if number > max_lag else 0.0  # when the lag allows the round to begin
        ready_s = np.maximum(ready_s, opened_s) + times_s[:, number]
        updated_s.append(max(updated_s[-1] if updated_s else 0.0, float(ready_s.max())) + learner_s)
    counted = rounds - 1 - WARM_UP
    return (updated_s[-1] - updated_s[WARM_UP]) / float(counted)


def _stretched_s(collecting_s: float, busy: float, learner_s: float, cores: int) -> float:
    """Time of a round in which `busy` workers compute, on average, while the learner updates, if all get equal CPU shares.

    While workers and learner both compute, each is slower by `stretch`. Then the one that takes longer continues alone.
    """
    stretch = max(1.0, (busy + 1) / cores)
    if learner_s > collecting_s:
        return collecting_s * stretch + learner_s - collecting_s
    return learner_s * stretch + (collecting_s - learner_s) * max(1.0, busy / cores)


def _larger(a: float, b: float) -> float:
    """A smooth maximum of two times. If they are similar, it is a little larger than both, because each of them is then the
    larger one in some rounds.
    """
    return math.pow(math.pow(a, SHARPNESS) + math.pow(b, SHARPNESS), 1 / SHARPNESS)
