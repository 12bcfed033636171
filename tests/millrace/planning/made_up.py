"""Measurements that nobody made, of environments and machines, for the pure parts of `millrace plan`."""

from __future__ import annotations

from typing import Any

from millrace.planning.expected_rate import Situation, Sizes, steps_per_s
from millrace.planning.measurements import ActionKind, Machine, Measurements, Overheads, StepCosts
from millrace.planning.recommendation import Learning, best, candidates
from millrace.protocol.random_streams import Purpose, generator

TRIED = 16  # workers that were tried side by side, if steps wait
NO_OVERHEADS = Overheads(row_s=0, lane_row_s=0, copy_row_s=0, sent_s=0, round_s=0, rollout_s=0, received_s=0, update_s=0)
OVERHEADS = Overheads(
    row_s=1e-4, lane_row_s=2e-5, copy_row_s=1e-5, sent_s=2e-4, round_s=1e-3, rollout_s=2e-4, received_s=1e-6, update_s=1e-4
)
PPO = Learning(envs=8, rollout_steps=128, least_steps=32)
REPLAY = Learning(envs=8, rollout_steps=8)
MACHINE = Machine(cores=2, free_bytes=16 << 30)


def costs(workers: int, *, wait_s: float, cpu_s: float, std_s: float = 0.0) -> StepCosts:
    """Of steps that wait and compute for so long, whatever the number of workers."""
    mean_s = wait_s + cpu_s
    return StepCosts(workers=workers, steps=100, mean_s=mean_s, median_s=mean_s, p95_s=mean_s, std_s=std_s, cpu_s=cpu_s)


def measured(
    *,
    wait_s: float = 0.0,
    cpu_s: float = 1e-4,
    std_s: float = 0.0,
    tried: int = TRIED,
    action: ActionKind = "box",
    **others: Any,
) -> Measurements:
    """Of such steps, alone and with so many workers side by side."""
    alone = costs(1, wait_s=wait_s, cpu_s=cpu_s, std_s=std_s)
    most = costs(tried, wait_s=wait_s, cpu_s=cpu_s, std_s=std_s)
    side_by_side = (alone, most) if tried > 1 else (alone,)
    return Measurements(env="made-up", action=action, side_by_side=side_by_side, **{"worker_bytes": 60 << 20, **others})


def situation(found: Measurements, overheads: Overheads = OVERHEADS, machine: Machine = MACHINE, **others: Any) -> Situation:
    """Where a run of this environment will be."""
    return Situation(measured=found, overheads=overheads, machine=machine, **others)


def rate(sizes: Sizes, where: Situation) -> float:
    """The env steps/s to expect."""
    return steps_per_s(sizes, where, generator(1, Purpose.ROUNDS))


def chosen(where: Situation, learning: Learning = PPO) -> Sizes:
    """The sizes that a plan chooses."""
    return best({each: rate(each, where) for each in candidates(learning, where.measured, where.machine)})
