"""Checks the arrays of a `Stepped`, which have a row for every copy of a lane of a vector environment. Pure."""

from __future__ import annotations

from collections.abc import Sequence

from millrace.protocol.messages import Stepped
from millrace.protocol.rows.array_checks import Expected, wrong_arrays, wrong_observation
from millrace.protocol.specs import StepSpec


def wrong_rows(answer: Stepped, spec: StepSpec, axes: Sequence[str] | None) -> str:
    """What is wrong with the arrays of an answer; empty if nothing is. Values are only checked if `axes` is not None."""
    N = spec.lanes[answer.lane] * spec.seats_of_copy
    numbers = [
        Expected("reward", answer.reward, (N,), "float64"),
        Expected("terminated", answer.terminated, (N,), "bool"),
        Expected("truncated", answer.truncated, (N,), "bool"),
    ]
    return wrong_observation(answer.obs, spec.leaves, (N,), axes) or wrong_arrays(numbers, axes)
