"""A gradient against the slope of what it is of, by central differences in float64."""

from __future__ import annotations

from collections.abc import Callable

from millrace.protocol.arrays import Array

STEP = 1e-6


def is_the_slope(grad: Array, of: Callable[[], float], flat: Array, relative: float, absolute: float = 0.0) -> None:
    """Asserts that `grad` [P] is the slope of `of` by each of the parameters `flat` [P], which are as they were afterwards.

    They may differ by `relative` of a gradient above 1, or of 1, and by `absolute` besides.
    """
    for i in range(len(flat)):
        middle = flat[i]
        flat[i] = middle + STEP
        above = of()
        flat[i] = middle - STEP
        below = of()
        flat[i] = middle
        assert abs((above - below) / (2 * STEP) - grad[i]) < relative * max(1, abs(grad[i])) + absolute, i
