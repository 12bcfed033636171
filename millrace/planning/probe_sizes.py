"""How many workers and copies the sessions of a probe have. Pure.

Rule: no session needs more copies than are allowed, or more than `OF_MEMORY` of the free memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from millrace.planning.measurements import WORKER_BYTES, Machine, Measurements

MOST_PER_CORE = 8  # largest number of workers to try per core
MOST_AT_LEAST = 16  # number of workers to try even if `MOST_PER_CORE` allows fewer
COPIES_OF_SHORT = 8  # number of copies in a worker if steps are short
GROWTH = 4  # each number of workers to try is this many times the one before
OF_MEMORY = 0.7  # the probe uses at most this share of the free memory


class SessionSize(NamedTuple):
    """The number of workers in a session, and of copies in each of them."""

    workers: int = 1
    each: int = 1

    @property
    def copies(self) -> int:
        """The number of copies of all workers together."""
        return self.workers * self.each


def most_each(measured: Measurements, machine: Machine) -> int:
    """How many copies to step in each worker if steps are short, so that a worker for each core is still allowed."""
    most = COPIES_OF_SHORT
    if machine.most_copies:
        most = min(most, machine.most_copies // machine.cores)
    if machine.free_bytes is not None:
        room = OF_MEMORY * machine.free_bytes / machine.cores - WORKER_BYTES
        most = min(most, int(room / measured.copy_bytes))
    return max(1, most)


def between(worked: int, failed: int) -> int:
    """The number of copies to try next if `worked` copies worked and `failed` failed; 0 if no number is between them.

    Its ratios to both are about equal, because the numbers tried before were far apart.
    """
    return max(worked + 1, math.isqrt(worked * failed)) if failed > worked + 1 else 0


def two_fit(measured: Measurements, machine: Machine) -> bool:
    """Whether two copies in one worker fit into the memory. Two are always allowed: one trains, the other evaluates."""
    return machine.free_bytes is None or WORKER_BYTES + 2 * measured.copy_bytes <= OF_MEMORY * machine.free_bytes


def enough_s(measured: Measurements, machine: Machine, each: int, steps: int) -> float:
    """About how long it takes to measure all numbers of copies, if each copy starts, is reset, and takes so many steps."""
    one_s = measured.reset_s + steps * measured.step_with_reset_s
    sizes = list(numbers_of_workers(measured, machine, each))
    starts = sum(max(1.0, workers / machine.cores) for workers in (1, *sizes, 1))
    return starts * measured.start_s + (len(sizes) + 3) * one_s  # one copy alone, and two that take turns in a worker


def numbers_of_workers(measured: Measurements, machine: Machine, each: int) -> Iterator[int]:
    """The numbers of workers to try, ascending. `each`: the number of copies of each worker."""
    alone = measured.alone
    limit = max(MOST_AT_LEAST, MOST_PER_CORE * machine.cores)
    if machine.free_bytes is not None:
        limit = min(limit, int(OF_MEMORY * machine.free_bytes / (WORKER_BYTES + each * measured.copy_bytes)))
    if machine.most_copies:
        limit = min(limit, machine.most_copies // each)
    # Try more copies than cores only if steps spend time waiting rather than computing.
    limit = min(limit, machine.cores if alone.computes else math.ceil(machine.cores / max(alone.cpu_share, 1e-3)))
    workers = max(2, machine.cores)
    while workers < limit:
        yield workers
        workers *= GROWTH
    if limit > 1:
        yield limit
