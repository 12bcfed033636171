"""Parts that the updates of all algorithms share: schedules, and the check that metrics are finite."""

from __future__ import annotations

import math
from collections.abc import Mapping

from protocol.errors import RunError


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
