"""Where an environment's action masks are: under the key `action_mask` of a Dict observation, or of `info`.

Rule: in a masked run, `action_mask` in an observation is a mask and not a feature. The learner and the workers both use this
file, which looks only at the spaces, so they always agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
from gymnasium import spaces

from millrace.protocol.envs.spaces import action_spec, observation_leaves, with_last
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.masks import MASK
from millrace.protocol.specs import Leaf


def has_mask(observation: gymnasium.Space[Any], action: gymnasium.Space[Any]) -> bool:
    """Whether an observation contains a mask of the allowed actions: under `action_mask`, with one bit per choice."""
    if not (isinstance(observation, spaces.Dict) and MASK in observation.spaces and len(observation.spaces) > 1):
        return False
    try:
        leaves = observation_leaves(observation.spaces[MASK])
        wanted = action_spec(action).choices
    except UsageError:
        return False
    return 0 < wanted == sum(math.prod(leaf.shape) for leaf in leaves) and all(map(_has_bits, leaves))


def wrong_mask(observation: gymnasium.Space[Any], action: gymnasium.Space[Any]) -> str:
    """Why the part `action_mask` of a Dict observation can't be a mask, and what to do.

    Empty if it is a mask, if there is no such part, or if an action has no choices.
    """
    if not (isinstance(observation, spaces.Dict) and MASK in observation.spaces and len(observation.spaces) > 1):
        return ""
    choices = action_spec(action).choices
    if not choices or has_mask(observation, action):
        return ""
    found = observation_leaves(observation.spaces[MASK])
    stacked = any(len(leaf.shape) > 1 and leaf.shape[-1] == choices for leaf in found)
    cause = "a wrapper has stacked it, so stack only the images (millrace:StackImages), or" if stacked else "correct it, or"
    got = ", ".join(f"{leaf.dtype}{list(leaf.shape)}" for leaf in found) or "nothing"
    return (
        f"observation {MASK}: expected a mask, a MultiBinary or a Box of int8 or bool with a bit for each of {choices} "
        f"choices, got {got}; {cause} set action_masks to none, which makes it an ordinary part of the observation"
    )


def _has_bits(leaf: Leaf) -> bool:
    match leaf.kind:
        case "multibinary":
            return True
        case "box":
            return leaf.dtype in ("bool", "int8", "uint8")
        case _:
            return set(leaf.sizes) == {2} and set(leaf.start) == {0}


def without_mask(observation: gymnasium.Space[Any], action: gymnasium.Space[Any]) -> gymnasium.Space[Any]:
    """The observation space without the mask, if it has one."""
    if not has_mask(observation, action):
        return observation
    assert isinstance(observation, spaces.Dict)
    return spaces.Dict([(key, space) for key, space in observation.spaces.items() if key != MASK])


def seen_space(
    observation: gymnasium.Space[Any], action: gymnasium.Space[Any], *, masked: bool, critic_keys: Sequence[str]
) -> gymnasium.Space[Any]:
    """The observation space of stored rows. In a masked run, it has no mask. The critic's keys come last."""
    return with_last(without_mask(observation, action) if masked else observation, critic_keys)
