"""The time of an update's matrix products alone, at one core's highest speed: a lower bound on an update's time.

Rule: the number of operations and the speed are measured, not assumed. torch counts the floating-point operations of the
products in one update, forward and backward, while the networks run in torch. The speed is that of the fastest square
product that was tried. Activations, the loss, the optimizer and every call take additional time, so an update can come close
to the bound, but not reach it.
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

    `run` performs `updates` updates, with networks that run in torch.
    """
    with FlopCounterMode(display=False) as counter:
        run()
    flop: int = counter.get_total_flops()
    return flop / updates / flop_per_s() * 1e3


@cache
def flop_per_s() -> float:
    """Floating-point operations per second of CPU time in the fastest product of two square float32 matrices.

    It is measured with one thread.
    """
    with threadpool_limits(1):
        return max(_speed(size) for size in SIZES)


def _speed(size: int) -> float:
    matrix = np.random.default_rng(0).normal(size=(size, size)).astype(np.float32)
    out = np.empty_like(matrix)
    repeats = 2 * SIZES[-1] ** 3 // size**3
    fastest = min(_seconds(lambda: np.matmul(matrix, matrix, out=out), repeats) for _ in range(TRIES))
    return 2 * size**3 / fastest


def _seconds(work: Callable[[], object], repeats: int) -> float:
    """Mean CPU seconds of one call."""
    start = time.process_time()
    for _ in range(repeats):
        work()
    return (time.process_time() - start) / repeats
