"""The random actions of a probe: their size, and what they follow of masks."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest

from millrace.planning.random_actions import RandomActions, SeenMasks

SEEN = gymnasium.spaces.Box(-1, 1, (3,))
COUNT = 100
GOES_ON = np.zeros((2, COUNT), bool)  # terminated and truncated


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("bound", [math.inf, None])
def test_actions_without_bounds_are_small_and_bounded_ones_fill_their_bounds(dtype: Any, bound: float | None) -> None:
    """A bound of None is the largest number of the dtype."""
    none = float(np.finfo(dtype).max) if bound is None else bound
    low, high = np.array([-none, 0, -none, -500], dtype), np.array([none, none, 1, 500], dtype)
    box = gymnasium.spaces.Box(low, high, dtype=dtype)
    space = gymnasium.spaces.Dict({"x": gymnasium.spaces.Tuple([box, gymnasium.spaces.Discrete(3)])})
    chosen = RandomActions(SEEN, space).choose(range(1, COUNT + 1), np.zeros((COUNT, 3)), {}, *GOES_ON)
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
    assert (np.abs(RandomActions(SEEN, space).choose(range(1, COUNT + 1), np.zeros((COUNT, 3)), {}, *GOES_ON)) < 20).all()


# ---------------------------------------------------------------------------------------------------------------- the masks

MASK = np.array([0, 1, 0, 1], np.int8)


def seen_masks(*calls: tuple[dict[str, Any], bool, bool]) -> SeenMasks:
    """What is found if the calls of one copy return these infos and flags. Actions obey the masks."""
    actions = RandomActions(SEEN, gymnasium.spaces.Discrete(4))
    for number, (infos, terminated, truncated) in enumerate(calls, start=1):
        flags = np.array([terminated]), np.array([truncated])
        (action,) = actions.choose([number], np.zeros((1, 3)), infos, *flags)
        assert action in np.flatnonzero(infos.get("action_mask", np.ones((1, 4)))[0])
    return actions.masks


THERE = {"action_mask": MASK[None]}


def test_masks_in_info_are_usable_if_there_is_one_wherever_an_action_is_chosen() -> None:
    assert seen_masks((THERE, False, False), ({}, True, False), (THERE, False, False)) == (True, "")
    assert seen_masks((THERE, False, False), ({}, False, True), (THERE, False, False)) == (True, "")
    assert seen_masks(({}, False, False), ({}, False, False)) == (False, "")


@pytest.mark.parametrize(
    ("calls", "when"),
    [
        ([({}, False, False), (THERE, False, False)], "after a copy's first reset"),
        ([(THERE, False, False), (THERE, False, False), ({}, False, False)], "after call 3 of a copy"),
        ([(THERE, False, False), ({}, True, False), ({}, False, False)], "after call 3 of a copy"),
    ],
)
def test_masks_that_are_missing_where_an_action_is_chosen_are_found(calls: list[Any], when: str) -> None:
    in_info, wrong = seen_masks(*calls)
    assert in_info
    assert wrong.startswith(f"{when}, action_mask: expected 4 zeros and ones of int8 or bool in info, ")
    assert "got none" in wrong


def test_a_row_of_another_copy_without_a_mask_does_not_make_actions_forbidden() -> None:
    actions = RandomActions(SEEN, gymnasium.spaces.Discrete(4))
    infos = {"action_mask": np.stack([MASK] * COUNT), "_action_mask": np.arange(COUNT) > 0}
    chosen = actions.choose(range(1, COUNT + 1), np.zeros((COUNT, 3)), infos, *GOES_ON)
    assert {*map(int, chosen[1:])} == {1, 3}
    assert actions.masks.wrong.startswith("after a copy's first reset, ")


def test_an_agent_that_does_not_act_needs_no_mask() -> None:
    actions = RandomActions(SEEN, gymnasium.spaces.Discrete(4), agents=2)
    infos = {"action_mask": np.stack([MASK, MASK]), "_action_mask": np.array([True, False])}
    acts = np.array([True, False])
    assert len(actions.choose([1], np.zeros((2, 3)), infos, ~acts, np.zeros(2, bool))) == 2
    assert actions.masks == (True, "")
    assert len(actions.choose([2], np.zeros((2, 3)), infos, acts, np.zeros(2, bool))) == 2
    assert actions.masks.wrong.startswith("after call 2 of a copy, ")
