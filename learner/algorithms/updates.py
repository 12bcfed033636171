"""Parts that the updates of all algorithms share: schedules, and checks of what an algorithm returns.

A user's own algorithm may return anything. What cannot be used is said in one line that names the class.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from protocol.errors import RunError, UsageError
from protocol.policy.layout import acting_size, buffer_size
from protocol.specs import PolicySpec


def check_finite(metrics: Mapping[str, float], update: int, advice: str) -> None:
    """Raise `RunError`, which names the first metric that is not finite, if there is one. Call it before the step."""
    for name, number in metrics.items():
        if not math.isfinite(number):
            raise RunError(
                f"learner: update {update}: {name}: expected finite, got {number}; this step was not taken; try {advice}"
            )


def scheduled(first: float, schedule: str, remaining: float) -> float:
    """The value of a setting when this fraction of the run remains: `linear` falls to 0, `constant` does not change."""
    return first * (remaining if schedule == "linear" else 1)


def numbers(metrics: Any, who: str) -> dict[str, float]:
    """The metrics of an update as floats, by name: also numpy's and torch's scalars become floats.

    `who`: the class of the algorithm. Raises `UsageError` for anything but a dict of numbers by name.
    """
    if not isinstance(metrics, Mapping):
        raise UsageError(f"{who}.update: expected a dict of metrics, got {type(metrics).__name__}; return {{}} for none")
    found = {}
    for name, number in metrics.items():
        try:
            found[name] = float("text" if isinstance(number, str | bytes) or not isinstance(name, str) else number)
        except (TypeError, ValueError, OverflowError, RuntimeError):  # torch raises RuntimeError
            got = f"{type(number).__name__} for {name!r}"
            raise UsageError(f"{who}.update: metrics: expected a name and a number, got {got}") from None
    return found


def wrong_weights(weights: Any, policy: PolicySpec) -> Iterator[str]:
    """What is wrong with the form of an algorithm's weights: a line for each array that is not as the policy needs it."""
    if not isinstance(weights, tuple) or len(weights) != 2:
        yield f"weights: expected a pair of arrays, got {type(weights).__name__}"
        return
    sizes = {"parameters": acting_size(policy), "buffers": buffer_size(policy)}
    for (name, size), array in zip(sizes.items(), weights, strict=True):
        if not isinstance(array, np.ndarray):
            yield f"weights: {name}: expected a numpy array, got {type(array).__name__}"
        elif array.dtype != np.float32 or array.shape != (size,):
            yield f"weights: {name}: expected float32[{size}], got {array.dtype}{list(array.shape)}"


def check_weights(weights: Any, policy: PolicySpec, who: str) -> None:
    """Raise `UsageError` for weights that no worker could act with. `who`: the class of the algorithm."""
    if why := next(wrong_weights(weights, policy), None):
        raise UsageError(f"{who}.{why}; millrace.testing.check_algorithm finds such mistakes before a run")
