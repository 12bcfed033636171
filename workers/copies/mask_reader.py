"""Reads the masks of allowed actions that env copies report, in their observations or in `info`.

Rule: wherever an action will be chosen, there must be a mask. It must have a bit for each choice, and allow at least one
choice for each entry of the action; otherwise, the environment is at fault (`CopyFailed`). After an episode's end, no action
is chosen. If the episode was truncated, its last mask is kept nevertheless, because learning uses the value of the last
observation; if there is none, all actions are allowed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.action_masks import has_mask
from millrace.protocol.envs.mask_forms import mask_array, masks_of_copies
from millrace.protocol.envs.spaces import action_spec
from millrace.protocol.errors import safe_repr
from millrace.protocol.policy.masks import MASK, no_choice
from millrace.workers.copies.env_errors import CopyFailed

DTYPES = ("bool", "int8", "uint8", "int64", "int32")
_NONE: Mapping[str, Any] = {}


def unused_mask(infos: Iterable[Mapping[str, Any]], action: gymnasium.Space[Any]) -> str:
    """A line for the user if one of these infos contains a mask that the run does not use; else empty."""
    if not any(isinstance(info, Mapping) and MASK in info for info in infos) or not action_spec(action).choices:
        return ""
    return f"the environment's info has an {MASK}, which this run does not use; --action-masks info does"


class MaskReader:
    """Reads the masks of env copies with these spaces."""

    def __init__(self, observation: gymnasium.Space[Any], action: gymnasium.Space[Any]) -> None:
        self._action = action_spec(action)
        self._choices = self._action.choices
        self._in_observation = has_mask(observation, action)
        self.everything = np.ones(self._choices, bool)
        """the mask that allows every action"""
        self._where = "its observation" if self._in_observation else "info"

    def read(self, n: int, observation: Any, info: Mapping[str, Any], terminated: Any, truncated: Any) -> Bools:
        """The mask [choices] of copy `n` after a step or a reset. Raises `CopyFailed` if there is no valid one."""
        if terminated:
            return self.everything
        source = observation if self._in_observation else info
        value = source.get(MASK) if isinstance(source, Mapping) else None
        return self._mask(n, value, bool(truncated))

    def read_all(self, observation: Any, infos: Mapping[str, Any], terminated: Bools, truncated: Bools) -> Bools:
        """The masks [N, choices] of all copies of a vector environment. Raises `CopyFailed` if one has no valid mask.

        A copy that is `terminated` gets no action, and so needs no mask.
        """
        count = len(terminated)
        given = (observation if self._in_observation else infos).get(MASK)
        there = np.ones(count, bool) if self._in_observation else np.asarray(infos.get(f"_{MASK}", np.ones(count, bool)))
        rows = masks_of_copies(given, count)
        found = np.ones((count, self._choices), bool)
        for n in np.flatnonzero(~np.asarray(terminated, bool)).tolist():
            found[n] = self._mask(n, rows[n] if there[n] else None, bool(truncated[n]))
        return found

    def read_loop(
        self,
        observations: Sequence[Any],
        infos: Sequence[tuple[int, Mapping[str, Any]]],
        terminated: Sequence[Any],
        truncated: Sequence[Any],
        stepped: Sequence[int] | None = None,
    ) -> list[Bools]:
        """The mask of every copy of a loop. If `stepped` is given, only these copies need one; the masks of the
        others allow everything.
        """
        by_copy = dict(infos)
        of = range(len(observations)) if stepped is None else stepped
        return [
            self.read(n, observation, by_copy.get(n, _NONE), terminated[n], truncated[n]) if n in of else self.everything
            for n, observation in enumerate(observations)
        ]

    def _mask(self, n: int, value: Any, ended: bool) -> Bools:
        if value is None:
            if ended:
                return self.everything
            raise self._wrong(n, "none")
        array = mask_array(value)
        if array is None or array.size != self._choices or array.dtype.name not in DTYPES:
            raise self._wrong(n, _shown(value, array))
        mask: Bools = array.reshape(-1).astype(bool)
        if array.dtype.kind != "b" and (array.reshape(-1) != mask).any():
            raise self._wrong(n, f"the value {array.max() if array.max() > 1 else array.min()}")
        if no_choice(mask, self._action):
            if ended:
                return self.everything
            raise self._wrong(n, f"one without a choice, {one_line(str(mask.astype(int).tolist()), 100)}")
        return mask

    def _wrong(self, n: int, got: str) -> CopyFailed:
        parts = "" if len(self._action.sizes) < 2 else f" ({' + '.join(map(str, self._action.sizes))})"
        expected = f"expected {self._choices}{parts} zeros and ones of int8 or bool in {self._where}, at least one allowed"
        return CopyFailed(n, line=f"{MASK}: {expected}, got {got}; fix the environment, or set action_masks to none")


def _shown(value: Any, array: Array | None) -> str:
    if array is None or array.dtype.kind not in "biuf":
        return one_line(f"{type(value).__name__} {safe_repr(value)}", 80)
    return f"{array.dtype}{list(array.shape)}"
