"""The env copies of one lane of a vector environment, in each of gymnasium's three ways of resetting.

The law: what comes out is, bit for bit, what `gymnasium.vector.SyncVectorEnv` gives over the same copies. NEXT_STEP: the
step after an episode's end ignores the action and resets that copy. SAME_STEP: the ending step resets it, and hands the last
observation and info over inside the new info. DISABLED: whoever steps also resets.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from time import perf_counter
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from protocol.arrays import Array
from protocol.envs.spaces import exact_leaves, nester, reader
from protocol.errors import UsageError
from protocol.specs import StepSpec
from workers.collect.env_copies import PULSE_S, CopyRaised, Pulse

Infos = list[tuple[int, dict[str, Any]]]  # (copy, its info), where it is not empty


class Rows(NamedTuple):
    """Where a lane's copies put what they give: arrays of its own, or a part of shared memory."""

    obs: tuple[Array, ...]  # [N, *leaf] each
    reward: Array  # [N] float64
    terminated: Array  # [N] bool
    truncated: Array  # [N] bool


def new_rows(spec: StepSpec, lane: int) -> Rows:
    """Arrays of the lane's own."""
    N = spec.lanes[lane]
    obs = tuple(np.zeros((N, *leaf.shape), leaf.dtype) for leaf in spec.observation)
    return Rows(obs, np.zeros(N), np.zeros(N, bool), np.zeros(N, bool))


class SteppedLane:
    """N env copies that are stepped together."""

    def __init__(self, spec: StepSpec, lane: int, incarnation: int, rows: Rows, pulse: Pulse) -> None:
        """Make the copies, and reset none. Raises `UsageError` when their spaces are not the vector environment's."""
        self.incarnation = incarnation
        self.rows = rows
        self.steps = 0
        first = spec.first(lane)
        self._mode = spec.autoreset
        self._leaves = spec.observation
        self._envs: list[gymnasium.Env[Any, Any]] = []
        for copy in range(spec.lanes[lane]):
            pulse()
            env = spec.envs[spec.copies[first + copy]]
            try:
                self._envs.append(env.make(spec.render_mode))
                self._check_spaces(spec, copy)
            except UsageError:
                self.close()
                raise
            except Exception as error:
                self.close()
                raise CopyRaised(copy, "make") from error
        N = len(self._envs)
        space = self._envs[0].observation_space
        self._nested = isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple)
        self._read = reader(space)
        self._nested_actions = isinstance(self._envs[0].action_space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple)
        self._nest = nester(self._envs[0].action_space)
        self._steps = [env.step for env in self._envs]
        self._reward: list[Any] = [0.0] * N
        self._terminated: list[Any] = [False] * N
        # Copies that stand for lost ones stand at an episode's end: the next step resets those that nobody else does.
        self._truncated: list[Any] = [incarnation > 0] * N
        self._proven = False  # an environment whose first step fits its space, fits later

    def _check_spaces(self, spec: StepSpec, copy: int) -> None:
        env = self._envs[copy]
        try:
            fits = (exact_leaves(env.observation_space), exact_leaves(env.action_space)) == (spec.observation, spec.action)
        except UsageError:
            fits = False
        if not fits:
            raise UsageError(
                f"copy {copy}: its observations {env.observation_space} and actions {env.action_space} are not those of the "
                "vector environment; all copies must have the same, and each machine the same version of the environment"
            )

    def reset(self, copies: Sequence[int], seeds: Sequence[int | None], options: Any, pulse: Pulse) -> Infos:
        """Begin episodes in these copies."""
        infos: Infos = []
        for n, seed in zip(copies, seeds, strict=True):
            pulse()
            try:
                observation, info = self._envs[n].reset(seed=seed, options=options)
                self._put(n, observation)
            except Exception as error:
                raise CopyRaised(n, "reset") from error
            self._reward[n], self._terminated[n], self._truncated[n] = 0.0, False, False
            if info:
                infos.append((n, info))
        self.rows.reward[:], self.rows.terminated[:], self.rows.truncated[:] = 0.0, self._terminated, self._truncated
        return infos

    def step(self, actions: Sequence[Array], pulse: Pulse) -> Infos:
        """Step each copy with its row of the actions, [N, *leaf] for each leaf."""
        reward, terminated, truncated, obs = self._reward, self._terminated, self._truncated, self.rows.obs[0]
        each: Iterable[Any] = map(self._nest, zip(*actions, strict=True)) if self._nested_actions else actions[0]
        at_once = self._proven and not self._nested
        next_step, same_step = self._mode == "NextStep", self._mode == "SameStep"
        infos: Infos = []
        due = perf_counter() + PULSE_S
        for n, (step, action) in enumerate(zip(self._steps, each, strict=True)):
            resets = next_step and (terminated[n] or truncated[n])
            try:
                if resets:
                    observation, info = self._envs[n].reset()
                    reward[n], terminated[n], truncated[n] = 0.0, False, False
                else:
                    observation, reward[n], terminated[n], truncated[n], info = step(action)
                    if same_step and (terminated[n] or truncated[n]):
                        resets = True
                        last = {"final_obs": observation, "final_info": info}
                        observation, info = self._envs[n].reset()
                        info = last | info
                if at_once:
                    obs[n] = observation
                else:
                    self._put(n, observation)
            except Exception as error:
                raise CopyRaised(n, "reset" if resets else f"step {self.steps}") from error
            if info:
                infos.append((n, info))
            if perf_counter() > due:
                pulse()
                due = perf_counter() + PULSE_S
        self._proven = True
        self.steps += 1
        self.rows.reward[:], self.rows.terminated[:], self.rows.truncated[:] = reward, terminated, truncated
        return infos

    def call(self, copies: Sequence[int], name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> list[Any]:
        """What the attribute is, or gives when it is called, for each of these copies. Raises what it raises."""
        found = []
        for n in copies:
            attribute = self._envs[n].get_wrapper_attr(name)
            found.append(attribute(*args, **kwargs) if callable(attribute) else attribute)
        return found

    def assign(self, copies: Sequence[int], name: str, values: Sequence[Any]) -> None:
        """Set the attribute, one value for each of these copies."""
        for n, value in zip(copies, values, strict=True):
            self._envs[n].set_wrapper_attr(name, value)

    def close(self) -> None:
        """Close every copy, whatever it says."""
        for env in self._envs:
            with suppress(Exception):
                env.close()

    def _put(self, n: int, observation: Any) -> None:
        """Lay an observation into the rows, leaf by leaf. Raises `ValueError` if it is not what its space says."""
        for leaf, rows, value in zip(self._leaves, self.rows.obs, self._read(observation), strict=True):
            if not self._proven:
                array = np.asarray(value)
                if array.shape != leaf.shape or not np.can_cast(array.dtype, rows.dtype, "same_kind"):
                    raise ValueError(
                        f"observation {leaf.path}".strip() + f" expected {leaf.dtype}{list(leaf.shape)} as its space says, "
                        f"got {array.dtype}{list(array.shape)}"
                    )
            rows[n] = value
