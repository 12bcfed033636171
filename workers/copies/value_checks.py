"""Checks, before rows are sent, that their values are finite and within their spaces. `row_writers` has checked the shapes.

If a value is wrong, each function raises `EnvironmentFailed`. The error names the lane (or an evaluation if `lane` is None),
and the step and copy of the first wrong value. Arrays are [rows, N, …] with the axes `RunSpec.row_axes`; row 0 is step
`first_step`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.rows.array_checks import Axes, wrong_values
from millrace.protocol.specs import Leaf
from millrace.workers.copies.env_errors import environment_failed


# rule IN_SPACE
def check_observed(lane: int | None, leaves: Sequence[Leaf], obs: Sequence[Array], axes: Axes, first_step: int = 0) -> None:
    """Check observations [rows, N, *leaf]."""
    for leaf, array in zip(leaves, obs, strict=True):
        if why := wrong_values(array, leaf, axes, first_step):
            raise environment_failed(lane, f"{leaf.name}: {why}")


def check_rewards(lane: int | None, reward: Array, axes: Axes, first_step: int = 0) -> Array:
    """Convert rewards to float32, check them, and return them."""
    with np.errstate(over="ignore"):
        stored = reward.astype(np.float32)
    if why := wrong_values(stored, None, axes, first_step):
        raise environment_failed(lane, f"reward: {why}")
    return stored


def check_acted(lane: int | None, name: str, array: Array, obs: Sequence[Array], axes: Axes, first_step: int = 0) -> None:
    """Check that the policy's outputs are finite. If they aren't, the error blames observations that are too large."""
    if why := wrong_values(array, None, axes, first_step):
        largest = max((float(np.abs(leaf).max(initial=0)) for leaf in obs if leaf.dtype.kind == "f"), default=0)
        line = f"{name} of the policy: {why}, from observations up to {largest:g}"
        raise environment_failed(lane, f"{line}; wrap the environment so that they are smaller")
