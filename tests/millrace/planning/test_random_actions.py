"""The random actions of a probe: their size, and what they follow of masks."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest

from millrace.planning.random_actions import RandomActions

SEEN = gymnasium.spaces.Box(-1, 1, (3,))
COUNT = 100


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("bound", [math.inf, None])
def test_actions_without_bounds_are_small_and_bounded_ones_fill_their_bounds(dtype: Any, bound: float | None) -> None:
    """A bound of None is the largest number of the dtype."""
    none = float(np.finfo(dtype).max) if bound is None else bound
    low, high = np.array([-none, 0, -none, -500], dtype), np.array([none, none, 1, 500], dtype)
    box = gymnasium.spaces.Box(low, high, dtype=dtype)
    space = gymnasium.spaces.Dict({"x": gymnasium.spaces.Tuple([box, gymnasium.spaces.Discrete(3)])})
    chosen = RandomActions(SEEN, space).choose(range(COUNT), np.zeros((COUNT, 3)), {})
    assert all(space.contains(action) for action in chosen)
    numbers = np.array([action["x"][0] for action in chosen])
    assert (abs(numbers[:, :3]) < 20).all()
    assert (np.ptp(numbers[:, :3], axis=0) > 1).all()
    assert numbers[:, 3].min() < -400
    assert numbers[:, 3].max() > 400


@pytest.mark.parametrize("largest", [1e39, np.finfo(np.float64).max])
def test_so_are_actions_of_float64_whose_bounds_a_policy_cannot_reach(largest: float) -> None:
    """A policy's actions are float32."""
    space = gymnasium.spaces.Box(-largest, largest, (2,), np.float64)
    assert (np.abs(RandomActions(SEEN, space).choose(range(COUNT), np.zeros((COUNT, 3)), {})) < 20).all()
