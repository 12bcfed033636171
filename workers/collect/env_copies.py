"""The env copies of one lane, stepped together, behind one small face: a loop over copies, or any vector environment.

The law is gymnasium's NEXT_STEP autoreset: the step after an episode's end ignores the action and resets that copy. What a
step returns is laid into a rollout at once, so both kinds may hand out the same buffers again and again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from time import perf_counter
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.wrappers import OrderEnforcing

from protocol.arrays import Array
from protocol.envs.spaces import reader
from protocol.envs.vectorized import check_resets_next_step
from protocol.errors import UsageError

Leaves = Sequence[Any]  # for each leaf of the observation: an array [N, *leaf], or a sequence of N observations
Pulse = Callable[[], None]

PULSE_S = 0.05  # a loop over slow copies shows this often that it is alive


class Row(NamedTuple):
    """What one step of N copies gave, each in whatever numpy lays into an array [N, …]."""

    leaves: Leaves
    reward: Any
    terminated: Any
    truncated: Any
    lost: Array | None = None
    """[N] bool, copies that are gone: their step was not made, the next one begins an episode on new ones"""


class CopyRaised(Exception):
    """The environment raised (it is the cause) in this copy; None where a vector environment does not say which."""

    def __init__(self, copy: int | None, doing: str) -> None:
        super().__init__(copy, doing)
        self.copy = copy
        self.doing = doing


class Copies(Protocol):
    """N env copies. Whatever the environment raises arrives as `CopyRaised`; what `pulse` raises passes through."""

    observation_space: gymnasium.Space[Any]
    """of one copy"""
    action_space: gymnasium.Space[Any]
    """of one copy"""

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Begin: one seed for each copy."""
        ...

    def step(self, actions: Array, pulse: Pulse) -> Row:
        """Step with actions [N, *action] of the environment's dtype; a copy that ended is reset instead."""
        ...

    def close(self) -> None:
        """Let go of the copies; raises nothing."""
        ...


def copy_seeds(seed: int, lane: int, incarnation: int, copies: int) -> list[int]:
    """A seed of 31 bits for each copy (environments hand them to C), all different in practice."""
    sequences = (np.random.SeedSequence([seed, lane, incarnation, copy]) for copy in range(copies))
    return [int(sequence.generate_state(1)[0] >> 1) for sequence in sequences]


class CopyLoop:
    """A loop over N environments."""

    def __init__(self, make: Callable[[], gymnasium.Env[Any, Any]], copies: int, pulse: Pulse) -> None:
        self._envs: list[gymnasium.Env[Any, Any]] = []
        for copy in range(copies):
            pulse()
            try:
                self._envs.append(make())
            except UsageError:
                self.close()
                raise
            except Exception as error:
                self.close()
                raise CopyRaised(copy, "make") from error
        self.observation_space = self._envs[0].observation_space
        self.action_space = self._envs[0].action_space
        self._nested = isinstance(self.observation_space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple)
        self._read = reader(self.observation_space)
        self._steps = [_unguarded(env).step for env in self._envs]
        self._observations: list[Any] = [None] * copies
        self._reward: list[Any] = [0.0] * copies
        self._terminated: list[Any] = [False] * copies
        self._truncated: list[Any] = [False] * copies

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Begin: one seed for each copy."""
        for n, (env, seed) in enumerate(zip(self._envs, seeds, strict=True)):
            pulse()
            try:
                self._observations[n], _ = env.reset(seed=seed)
            except Exception as error:
                raise CopyRaised(n, "reset") from error
            self._terminated[n] = self._truncated[n] = False
        return self._leaves()

    def step(self, actions: Array, pulse: Pulse) -> Row:
        """Step each copy, or reset it if it has ended."""
        observations, reward, terminated, truncated = self._observations, self._reward, self._terminated, self._truncated
        due = perf_counter() + PULSE_S
        for n, (step, action) in enumerate(zip(self._steps, actions, strict=True)):
            ended = terminated[n] or truncated[n]
            try:
                if ended:
                    observations[n], _ = self._envs[n].reset()
                    reward[n], terminated[n], truncated[n] = 0.0, False, False
                else:
                    observations[n], reward[n], terminated[n], truncated[n], _ = step(action)
            except Exception as error:
                raise CopyRaised(n, "reset" if ended else "step") from error
            if perf_counter() > due:
                pulse()
                due = perf_counter() + PULSE_S
        return Row(self._leaves(), reward, terminated, truncated)

    def _leaves(self) -> Leaves:
        if self._nested:
            return tuple(zip(*map(self._read, self._observations), strict=True))
        return (self._observations,)

    def close(self) -> None:
        """Close every copy, whatever it says."""
        for env in self._envs:
            with suppress(Exception):
                env.close()


def _unguarded(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """To be stepped, once it has been reset: without the wrapper that only watches that a reset comes first.

    It stands between each step and the environment, and costs a twentieth of CartPole's.
    """
    while type(env) is OrderEnforcing:
        env = env.env
    if isinstance(env, gymnasium.Wrapper):
        env.env = _unguarded(env.env)
    return env


class VectorCopies:
    """Any `gymnasium.vector.VectorEnv` that resets in the step after an episode's end."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        """Raises `UsageError` for another way of resetting."""
        check_resets_next_step(env)
        self._env = env
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space
        self._read = reader(self.observation_space)

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Begin: one seed for each copy, or the first of them where the environment takes only one."""
        pulse()
        if len(seeds) != self._env.num_envs:
            raise UsageError(f"vector environment {self._env}: expected {len(seeds)} copies, got {self._env.num_envs}")
        try:
            return self._read(self._first(seeds))
        except Exception as error:
            raise CopyRaised(None, "reset") from error

    def _first(self, seeds: Sequence[int]) -> Any:
        """First observations. Most take a list of seeds, Atari's an array, some one number."""
        for given in (list(seeds), np.array(seeds)):
            with suppress(gymnasium.error.Error, TypeError):
                return self._env.reset(seed=given)[0]  # type: ignore[arg-type]
        return self._env.reset(seed=seeds[0])[0]

    def step(self, actions: Array, pulse: Pulse) -> Row:
        """Step all copies at once."""
        try:
            observation, reward, terminated, truncated, _ = self._env.step(actions)
        except Exception as error:
            raise CopyRaised(None, "step") from error
        return Row(self._read(observation), reward, terminated, truncated)

    def close(self) -> None:
        """Close it, whatever it says."""
        with suppress(Exception):
            self._env.close()
