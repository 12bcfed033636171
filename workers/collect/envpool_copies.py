"""The env copies of one lane as envpool steps them, with a clock of our own.

The law is NEXT_STEP autoreset, which envpool keeps, and exact flags, which it does not: an episode that fails in the very
step of its time limit comes as truncated alone. So envpool is given one step more than there is, and never reaches its
limit: a copy that has had its steps is truncated here, and reset by hand in the step after.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from protocol.arrays import Array
from protocol.envs.envpool import EnvpoolSpec
from protocol.envs.spaces import make_flatten
from workers.collect.env_copies import Leaves, StepResult
from workers.env_errors import CopyRaised
from workers.env_loop import Pulse


class EnvpoolCopies:
    """N copies in one pool, made at the first reset: envpool takes its seeds only then."""

    def __init__(self, pool: EnvpoolSpec, copies: int) -> None:
        self.observation_space = pool.observation_space
        self.action_space = pool.action_space
        self._pool = pool
        self._env: VectorEnv[Any, Any, Any] | None = None
        self._read = make_flatten(self.observation_space)
        self._cut = np.zeros(copies, bool)  # [N] truncated here: envpool does not know of it

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Begin: one seed for each copy."""
        pulse()
        try:
            self._env = self._pool.make(seeds)
            return self._read(self._env.reset()[0])
        except Exception as error:
            raise CopyRaised(None, "reset") from error

    def step(self, actions: Array, pulse: Pulse) -> StepResult:
        """Step all copies at once; those that were cut are reset."""
        try:
            row, elapsed = self._step_beside_cut(actions) if self._cut.any() else self._step(actions)
        except Exception as error:
            raise CopyRaised(None, "step") from error
        over = elapsed >= self._pool.limit
        self._cut = over & ~row.terminated & ~row.truncated
        return row._replace(truncated=row.truncated | over)

    def _step(self, actions: Array, copies: Array | None = None) -> tuple[StepResult, Array]:
        """Of these copies, or all: what they gave, and how many steps [n] their episodes have had."""
        observation, reward, terminated, truncated, infos = self._env.step(actions, copies)  # type: ignore[union-attr,call-arg]
        return StepResult(self._read(observation), reward, terminated, truncated), infos["elapsed_step"]

    def _step_beside_cut(self, actions: Array) -> tuple[StepResult, Array]:
        cut, rest = np.flatnonzero(self._cut), np.flatnonzero(~self._cut)
        first = self._read(self._env.reset(cut)[0])  # type: ignore[union-attr,arg-type,call-arg]
        row, elapsed = self._step(actions[rest], rest)

        def whole(of_rest: Array, of_cut: Any = 0) -> Array:
            array = np.empty((len(actions), *of_rest.shape[1:]), of_rest.dtype)
            array[rest], array[cut] = of_rest, of_cut
            return array

        leaves = [whole(later, begun) for later, begun in zip(row.leaves, first, strict=True)]
        return StepResult(leaves, whole(row.reward), whole(row.terminated), whole(row.truncated)), whole(elapsed)

    def close(self) -> None:
        """Let go of it, whatever it says; its thread ends with it."""
        if self._env is not None:
            with suppress(Exception):
                self._env.close()
            self._env = None
