"""The env copies of one lane in envpool, with time limits that are applied here.

Rule: autoreset is NextStep, as in envpool. Flags are exact, unlike envpool's: if an episode terminates in the last step that
its time limit allows, envpool reports it only as truncated. Therefore, envpool gets a limit that is one step longer. It
never reaches this limit, because this file truncates an episode at its time limit and resets the copy explicitly in the next
step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from millrace.extras.envs.envpool import EnvpoolSpec
from millrace.protocol.arrays import Array
from millrace.protocol.envs.spaces import make_flatten
from millrace.workers.activity import RESETTING, STEPPING, activity
from millrace.workers.copies.env_copies import Leaves, StepResult
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.episode_facts import facts_of_copies, of_ended
from millrace.workers.copy_slots import close_copy, give_back


class EnvpoolCopies:
    """N copies in one pool. `reset` makes the pool, because envpool accepts seeds only when a pool is made."""

    def __init__(self, pool: EnvpoolSpec, copies: int, facts: Sequence[str] = ()) -> None:
        """`facts`: names of the numbers in `info` that are reported for each episode."""
        self.note = ""
        self._facts = facts
        self.observation_space = pool.observation_space
        self.action_space = pool.action_space
        self._pool = pool
        self._activity = activity()
        self._env: VectorEnv[Any, Any, Any] | None = None
        self._read = make_flatten(self.observation_space)
        self._truncated = np.zeros(copies, bool)  # [N] whether this class truncated the newest step; envpool doesn't know

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Start episodes in all copies, with a seed for each."""
        pulse()
        try:
            with activity().during(RESETTING):
                self._env = self._pool.make(seeds)
                return self._read(self._env.reset()[0])
        except BaseException as error:
            raise CopyFailed(None, "reset") from error

    def step(self, actions: Array, pulse: Pulse) -> StepResult:
        """Step all copies at once, and reset those that were truncated here."""
        self._activity.begin(STEPPING)
        try:
            result, elapsed, facts = self._step_and_reset(actions) if self._truncated.any() else self._step(actions)
        except CopyFailed:
            raise
        except BaseException as error:
            raise CopyFailed(None, "step") from error
        finally:
            self._activity.end(len(actions))
        at_limit = elapsed >= self._pool.limit
        self._truncated = at_limit & ~result.terminated & ~result.truncated
        truncated = result.truncated | at_limit
        return result._replace(
            truncated=truncated, facts=of_ended(facts, result.terminated | truncated) if self._facts else {}
        )

    def _step(self, actions: Array, copies: Array | None = None) -> tuple[StepResult, Array, Array]:
        """Step these n copies, or all copies. Returns the result, the length so far [n] of each episode, and the facts
        [n, names].
        """
        observation, reward, terminated, truncated, infos = self._env.step(actions, copies)  # type: ignore[union-attr,call-arg]
        facts = facts_of_copies(self._facts, infos, len(actions)) if self._facts else np.empty((len(actions), 0))
        return StepResult(self._read(observation), reward, terminated, truncated), infos["elapsed_step"], facts

    def _step_and_reset(self, actions: Array) -> tuple[StepResult, Array, Array]:
        """Reset the copies that were truncated here, and step the others. Returns the same as `_step`, for all copies."""
        reset = np.flatnonzero(self._truncated)
        rest = np.flatnonzero(~self._truncated)
        first = self._read(self._env.reset(reset)[0])  # type: ignore[union-attr,arg-type,call-arg]
        result, elapsed, facts = self._step(actions[rest], rest)

        def merged(of_rest: Array, of_reset: Any = 0) -> Array:
            array = np.empty((len(actions), *of_rest.shape[1:]), of_rest.dtype)
            array[rest] = of_rest
            array[reset] = of_reset
            return array

        leaves = [merged(stepped, started) for stepped, started in zip(result.leaves, first, strict=True)]
        flags = merged(result.terminated), merged(result.truncated)
        return StepResult(leaves, merged(result.reward), *flags), merged(elapsed), merged(facts)

    def assign(self, name: str, packed: bytes, pulse: Pulse) -> None:
        """Raises `CopyFailed`, because the copies aren't Python objects."""
        raise CopyFailed(None, line="envpool's env copies have no attributes")

    def close(self) -> None:
        """Close the pool and its threads, ignoring exceptions."""
        if self._env is not None:
            close_copy(self._env)
            self._env = None
        give_back(self)
