"""What an update would take if it were arithmetic alone: its matrix products, at the best speed that one core has for them.

Rule: both numbers are measured, not assumed. torch counts the products of one update, forward and backward, while it passes
in torch; the speed is that of the fastest square product that was tried. Activations, the loss, the optimizer and every call
come on top, so an update can come close to this time, but not reach it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache

import numpy as np
from threadpoolctl import threadpool_limits
from torch.utils.flop_counter import FlopCounterMode

SIZES = (128, 256, 512)
TRIES = 15


def products_ms(run: Callable[[], object], updates: int) -> float:
    """Milliseconds that the matrix products of an update take at the speed of `flop_per_s`.

    `run` makes so many updates, whose networks pass in torch.
    """
    with FlopCounterMode(display=False) as counter:
        run()
    flop: int = counter.get_total_flops()
    return flop / updates / flop_per_s() * 1e3


@cache
def flop_per_s() -> float:
    """Floating-point operations per second of CPU time in the fastest product of two square float32 matrices, one thread."""
    with threadpool_limits(1):
        return max(_speed(size) for size in SIZES)


def _speed(size: int) -> float:
    matrix = np.random.default_rng(0).normal(size=(size, size)).astype(np.float32)
    out = np.empty_like(matrix)
    repeats = 2 * SIZES[-1] ** 3 // size**3
    fastest = min(_seconds(lambda: np.matmul(matrix, matrix, out=out), repeats) for _ in range(TRIES))
    return 2 * size**3 / fastest


def _seconds(work: Callable[[], object], repeats: int) -> float:
    """CPU seconds of one call."""
    start = time.process_time()
    for _ in range(repeats):
        work()
    return (time.process_time() - start) / repeats
