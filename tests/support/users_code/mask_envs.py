"""Environments that say which actions are allowed, in three forms. Whoever takes another action gets an error.

Rule: the reward is 1 for the last allowed choice of each entry, else 0. An episode terminates at random, or is truncated.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple

SIZES, STARTS = (3, 2, 5), (0, 3, 0)
CHOICES = 7


class _Masked(gymnasium.Env[Any, Any]):
    """`fault`: what the mask is from step 3 of an episode on: `short`, `missing`, `empty` or `two`."""

    sizes: tuple[int, ...] = (CHOICES,)
    starts: tuple[int, ...] = (0,)

    def __init__(self, fault: str = "") -> None:
        self._fault = fault

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._t = 0
        return self._next()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        chosen = [int(a) - start for a, start in zip(self.choices(action), self.starts, strict=True)]
        if not all(mask[a] for mask, a in zip(self._allowed, chosen, strict=True)):
            raise RuntimeError(f"illegal action {chosen}")
        reward = float(all(a == np.flatnonzero(mask)[-1] for mask, a in zip(self._allowed, chosen, strict=True)))
        self._t += 1
        ended = bool(self.np_random.random() < 0.05)
        return *self._next(ended)[:1], reward, ended, self._t >= 12, self._info

    def _next(self, ended: bool = False) -> tuple[Any, dict[str, Any]]:
        self._allowed = []
        for size in self.sizes:
            mask = self.np_random.random(size) < 0.4
            mask[self.np_random.integers(size)] = True
            self._allowed.append(mask)
        bits = np.concatenate(self._allowed)
        given: Any = self.given(bits * (not ended))
        if self._t >= 3:
            wrong = {"short": bits[1:], "missing": None, "empty": bits & False, "two": bits * np.int8(2)}
            given = wrong.get(self._fault, given)
        observation = bits.astype(np.float32)
        self._info = {} if given is None else {"action_mask": given}
        return observation, self._info

    def given(self, bits: Any) -> Any:
        """The mask as the environment reports it."""
        return bits.astype(np.int8)

    def choices(self, action: Any) -> Any:
        """What was chosen of each entry."""
        return np.ravel(action)


class InInfo(_Masked):
    """A mask of int8 in info."""

    observation_space = Box(0, 1, (CHOICES,))
    action_space = Discrete(CHOICES)


class Parts(_Masked):
    """A MultiDiscrete action, with a tuple of masks in info."""

    sizes, starts = SIZES, STARTS
    observation_space = Box(0, 1, (sum(SIZES),))
    action_space: Any = MultiDiscrete(list(SIZES), start=list(STARTS))

    def given(self, bits: Any) -> Any:
        return tuple(np.split(bits.astype(bool), np.cumsum(SIZES)[:-1]))


class Mixed(Parts):
    """The same choices as two of three parts of a Dict: between them are numbers, which a mask says nothing of."""

    action_space = Dict(
        {
            "a": Discrete(SIZES[0]),
            "b": Box(-1, 1, (2,)),
            "c": Tuple([MultiBinary(2), MultiDiscrete(list(SIZES[1:]), start=list(STARTS[1:]))]),
        }
    )

    def choices(self, action: Any) -> Any:
        return [action["a"], *action["c"][1]]


class InObservation(_Masked):
    """A mask under a key of a Dict observation."""

    observation_space = Dict({"action_mask": MultiBinary(CHOICES), "seen": Box(0, 1, (CHOICES,))})
    action_space = Discrete(CHOICES)

    def _next(self, ended: bool = False) -> tuple[Any, dict[str, Any]]:
        observation, info = super()._next(ended)
        self._info = {}
        return {"seen": observation, **info}, self._info


class PartsInObservation(Parts):
    """A MultiDiscrete action, with a tuple of masks under a key of a Dict observation."""

    observation_space: Any = Dict(
        {"action_mask": Tuple([MultiBinary(size) for size in SIZES]), "seen": Parts.observation_space}
    )

    def given(self, bits: Any) -> Any:
        return tuple(np.split(bits.astype(np.int8), np.cumsum(SIZES)[:-1]))

    def _next(self, ended: bool = False) -> tuple[Any, dict[str, Any]]:
        observation, info = super()._next(ended)
        self._info = {}
        return {"seen": observation, **info}, self._info


gymnasium.register("Mixed-v0", "tests.support.users_code.mask_envs:Mixed")
gymnasium.register("InInfo-v0", "tests.support.users_code.mask_envs:InInfo")
gymnasium.register("Parts-v0", "tests.support.users_code.mask_envs:Parts")
gymnasium.register("InObservation-v0", "tests.support.users_code.mask_envs:InObservation")
gymnasium.register("PartsInObservation-v0", "tests.support.users_code.mask_envs:PartsInObservation")
