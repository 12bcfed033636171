"""The env copies of one lane in one vector environment: any `gymnasium.vector.VectorEnv` with autoreset mode NextStep."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from millrace.extras.envs.vectorized import check_resets_next_step
from millrace.protocol.arrays import Array
from millrace.protocol.envs.action_masks import seen_space
from millrace.protocol.envs.answers import reset_answer, wrong_step
from millrace.protocol.envs.spaces import make_batched, make_flatten
from millrace.protocol.errors import UsageError
from millrace.protocol.wire.plain_values import unpack
from millrace.workers.activity import RESETTING, STEPPING, activity
from millrace.workers.copies.env_copies import Leaves, StepResult, set_attribute
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.episode_facts import Facts, facts_of_copies, of_ended
from millrace.workers.copies.mask_reader import MaskReader, unused_mask
from millrace.workers.copies.row_writers import missing_leaf
from millrace.workers.copy_slots import close_copy


class VectorCopies:
    """The env copies in a `gymnasium.vector.VectorEnv` with autoreset mode NextStep."""

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        facts: Sequence[str] = (),
        *,
        masked: bool = False,
        critic_keys: Sequence[str] = (),
    ) -> None:
        """The arguments are those of `LoopedCopies`. Raises `UsageError` for another autoreset mode."""
        check_resets_next_step(env)
        self._env = env
        self._activity = activity()
        self._facts = facts
        self._per_copy = (env.num_envs,)
        self.note = ""
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space
        self._masks = MaskReader(self.observation_space, self.action_space) if masked else None
        self.observation_space = seen_space(
            self.observation_space, self.action_space, masked=masked, critic_keys=critic_keys
        )
        self._read = make_flatten(self.observation_space)
        self._batched = make_batched(self.action_space)

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Start episodes in all copies, with a seed for each, or with the first seed if the environment accepts only one."""
        pulse()
        if len(seeds) != self._env.num_envs:
            raise UsageError(f"vector environment {self._env}: expected {len(seeds)} copies, got {self._env.num_envs}")
        try:
            with activity().during(RESETTING):
                observation, infos = reset_answer(self._first(seeds))
                leaves = self._read(observation)
            if self._masks is None:
                self.note = unused_mask([infos], self.action_space)
                return leaves
            no_end = np.zeros(self._per_copy, bool)
            return [*leaves, self._masks.read_all(observation, infos, no_end, no_end)]
        except CopyFailed:
            raise
        except BaseException as error:
            raise CopyFailed(None, "reset") from error

    def _first(self, seeds: Sequence[int]) -> Any:
        """Reset the environment. Most environments accept a list of seeds, Atari an array, and some only one number."""
        for seed in (list(seeds), np.array(seeds)):
            with suppress(gymnasium.error.Error, TypeError):
                return self._env.reset(seed=seed)  # type: ignore[arg-type]
        return self._env.reset(seed=seeds[0])

    def step(self, actions: Array, pulse: Pulse) -> StepResult:
        """Step all copies at once."""
        self._activity.begin(STEPPING)
        try:
            answer = self._env.step(self._batched(actions))
        except BaseException as error:
            raise CopyFailed(None, "step") from error
        finally:
            self._activity.end(self._env.num_envs)
        try:
            observation, reward, terminated, truncated, infos = answer
        except (TypeError, ValueError) as error:
            raise CopyFailed(None, "step", str(wrong_step(answer))) from error
        for name, array in (("reward", reward), ("terminated", terminated), ("truncated", truncated)):
            if np.shape(array) != self._per_copy:
                line = (
                    f"{name}: expected one for each of {self._per_copy[0]} copies, got an array of shape {np.shape(array)}"
                )
                raise CopyFailed(None, line=line)
        try:
            leaves: Leaves = self._read(observation)
            if self._masks is not None:
                leaves = [*leaves, self._masks.read_all(observation, infos, terminated, truncated)]
            ended = np.logical_or(terminated, truncated)  # they may be lists, or numbers
            return StepResult(leaves, reward, terminated, truncated, facts=self._of_ended(infos, ended))
        except (LookupError, TypeError) as error:
            raise missing_leaf(None, observation, error) from error

    def assign(self, name: str, packed: bytes, pulse: Pulse) -> None:
        """Set an attribute of the vector environment, or of each of its copies if it has any (`SyncVectorEnv`)."""
        with self._activity.during(STEPPING):
            copies = getattr(self._env.unwrapped, "envs", None)
            if isinstance(copies, list | tuple):
                for n, env in enumerate(copies):
                    set_attribute(n, env, name, unpack(packed))
            else:
                set_attribute(None, self._env, name, unpack(packed))

    def _of_ended(self, infos: dict[str, Any], ended: Array) -> Facts:
        if not self._facts or not np.any(ended):
            return {}
        return of_ended(facts_of_copies(self._facts, infos, self._env.num_envs), ended)

    def close(self) -> None:
        """Close the vector environment, ignoring exceptions."""
        close_copy(self._env)
