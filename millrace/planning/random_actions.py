"""Chooses the random actions with which the probe steps an environment.

Rule: all copies take the same actions in the same order, so that they can be compared. No action is one that a mask forbids.
If a bound is so large that it means "no bound", actions are nevertheless as small as those of a new policy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from millrace.planning.stand_in import with_float_boxes
from millrace.protocol.arrays import Array, Bools
from millrace.protocol.envs.action_masks import has_mask
from millrace.protocol.envs.spaces import action_spec
from millrace.protocol.policy.masks import MASK
from millrace.protocol.specs import no_bound
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.mask_reader import MaskReader

SCRIPT = 1009  # number of random actions, which all copies take in the same order, in a loop
SEED = 1


class SeenMasks(NamedTuple):
    """The masks of allowed actions that copies reported while they were stepped."""

    in_info: bool
    """whether the infos contained masks"""
    wrong: str
    """why a run could not use the masks, and when that was found; empty if it could, or if there are none"""


class RandomActions:
    """The random actions for copies with these spaces, and what their masks were like."""

    def __init__(self, observation: gymnasium.Space[Any], action: gymnasium.Space[Any], agents: int = 1) -> None:
        """`agents`: number of rows that a copy has in the results of a vector environment."""
        self._space = with_float_boxes(action, _without_large_bounds)
        self._space.seed(SEED)
        self._script = [self._space.sample() for _ in range(SCRIPT)]
        spec = action_spec(action)
        self._has_choices = spec.choices > 0
        self._starts = np.cumsum(spec.sizes)[:-1].tolist()  # of the entries of an action, except for the first one
        self._masks = MaskReader(observation, action)
        self._in_observation = has_mask(observation, action)
        self._in_info = False
        self._wrong = ""
        self._agents = agents

    def choose(
        self, calls: Sequence[int], observation: Any, infos: Mapping[str, Any], terminated: Bools, truncated: Bools
    ) -> list[Any]:
        """An action for each row of a vector environment's results. A row that is `terminated` needs no mask.

        `calls`: for each copy in the results, the number of its calls so far, with the first reset.
        """
        allowed = self._allowed(calls, observation, infos, terminated, truncated)
        numbers = [number * self._agents + agent for number in calls for agent in range(self._agents)]
        return [self._action(number, mask) for number, mask in zip(numbers, allowed, strict=True)]

    @property
    def masks(self) -> SeenMasks:
        """The masks that the copies have reported so far."""
        seen = self._in_observation or self._in_info
        return SeenMasks(self._in_info and not self._in_observation, self._wrong if seen else "")

    def _allowed(
        self, calls: Sequence[int], observation: Any, infos: Mapping[str, Any], terminated: Bools, truncated: Bools
    ) -> Array:
        """The mask of each row. A row without one, although a run requires it, is noted and may take any action."""
        count = len(calls) * self._agents
        everything = np.broadcast_to(self._masks.everything, (count, len(self._masks.everything)))
        if not self._has_choices:
            return everything
        self._in_info |= MASK in infos
        try:
            return self._masks.read_all(observation, infos, terminated, truncated)
        except CopyFailed as error:
            call = calls[(error.copy or 0) // self._agents]
            when = "a copy's first reset" if call == 1 else f"call {call:,} of a copy"
            self._wrong = self._wrong or f"after {when}, {error.line}"
        over = np.ones(count, bool)  # so that no row needs a mask
        try:
            return self._masks.read_all(observation, infos, terminated=~over, truncated=over)
        except CopyFailed:  # what the environment calls a mask isn't one
            return everything

    def _action(self, number: int, mask: Bools) -> Any:
        action = self._script[number % SCRIPT]
        return action if mask.all() else _allowed_action(self._space, action, iter(np.split(mask, self._starts)))


def _without_large_bounds(box: spaces.Box) -> spaces.Box:
    """The space with infinite bounds in place of those that mean "no bound". Samples between infinite bounds are small."""
    none = no_bound(box.dtype.name)
    low = np.where(box.low <= -none, -np.inf, box.low)
    high = np.where(box.high >= none, np.inf, box.high)
    kind: Any = box.dtype.type
    return spaces.Box(low, high, dtype=kind)


def _allowed_action(space: gymnasium.Space[Any], action: Any, masks: Iterator[Bools]) -> Any:
    """The action with an allowed choice in each entry. `masks` are the masks of the entries, in the order of the space."""
    match space:
        case spaces.Dict():
            return {key: _allowed_action(inner, action[key], masks) for key, inner in space.spaces.items()}
        case spaces.Tuple():
            return tuple(_allowed_action(inner, part, masks) for inner, part in zip(space.spaces, action, strict=True))
        case spaces.Discrete() | spaces.MultiDiscrete():
            chosen = [_allowed_choice(choice, next(masks)) for choice in np.ravel(action - space.start).tolist()]
            return space.start + np.reshape(chosen, space.shape or ()).astype(space.dtype)
        case _:
            return action


def _allowed_choice(choice: int, mask: Bools) -> int:
    """An allowed choice that depends only on the given one and on the mask [choices]."""
    allowed = np.flatnonzero(mask)
    return int(allowed[choice % len(allowed)])
