"""The env copies of all lanes, stepped at once: each lane is a part of one vector environment, whose copies live elsewhere.

The law: a lane gets, bit for bit, what a loop over its copies would give. Its copies' seeds and actions are its own, and
NEXT_STEP autoreset is the vector environment's as it is the loop's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from protocol.arrays import Array
from protocol.envs.spaces import make_flatten
from protocol.errors import NoWorkers
from protocol.specs import RunSpec
from workers.collect.env_copies import EnvCopies, Leaves, StepResult
from workers.env_loop import Pulse


class SideBySide:
    """The lanes of a run, of equally many copies each; lane 0 has the vector environment's first ones."""

    def __init__(
        self, env: VectorEnv[Any, Any, Any], lanes: int, before: Callable[[Pulse], None] = lambda pulse: None
    ) -> None:
        """`before`: called before each wait for the vector environment, with what is to be called now and then meanwhile."""
        self.env = env
        self.nobody: NoWorkers | None = None
        """why nobody steps the copies any more"""
        self._lanes, self._before = lanes, before
        self._read = make_flatten(env.single_observation_space)
        self._row: StepResult | None = None

    def open(self, run: RunSpec, lane: int, pulse: Pulse) -> EnvCopies:
        """The copies of this lane: for `Collector`."""
        return _Part(self, slice(lane * run.copies, (lane + 1) * run.copies))

    def begin(self, lanes: Sequence[int], actions: Array, pulse: Pulse) -> None:
        """Step the copies of all lanes, with actions [L, N, *action]: for `Collector`."""
        order = sorted(range(len(lanes)), key=lanes.__getitem__)
        if [lanes[i] for i in order] != list(range(self._lanes)):
            raise ValueError(f"lanes expected all {self._lanes} of the vector environment at once, got {sorted(lanes)}")
        each = actions[order].reshape(-1, *actions.shape[2:])  # [L · N, *action]
        observation, reward, terminated, truncated, infos = self.wait(lambda: self.env.step(each), pulse)
        self._row = StepResult(self._read(observation), reward, terminated, truncated, infos.get("worker_lost"))

    def row(self, copies: slice) -> StepResult:
        """What these copies gave in the last step."""
        assert self._row is not None
        leaves, reward, terminated, truncated, lost = self._row
        lost = None if lost is None else lost[copies]
        return StepResult([leaf[copies] for leaf in leaves], reward[copies], terminated[copies], truncated[copies], lost)

    def reset(self, copies: slice, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Begin episodes in these copies."""
        mask = np.zeros(self.env.num_envs, bool)
        mask[copies] = True
        each: list[Any] = [None] * self.env.num_envs
        each[copies] = seeds
        options = {"reset_mask": mask}
        observation, _ = self.wait(lambda: self.env.reset(seed=each, options=options), pulse)  # type: ignore[arg-type]
        return [leaf[copies] for leaf in self._read(observation)]

    def wait(self, doing: Callable[[], Any], pulse: Pulse) -> Any:
        """Do what may wait for workers."""
        try:
            self._before(pulse)
            return doing()
        except NoWorkers as error:
            self.nobody = error
            raise


class _Part:
    """One lane's copies."""

    def __init__(self, whole: SideBySide, copies: slice) -> None:
        self._whole, self._copies = whole, copies
        self.observation_space = whole.env.single_observation_space
        self.action_space = whole.env.single_action_space

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Begin: one seed for each copy."""
        return self._whole.reset(self._copies, seeds, pulse)

    def step(self, actions: Array, pulse: Pulse) -> StepResult:
        """What `begin` stepped."""
        return self._whole.row(self._copies)

    def close(self) -> None:
        """Nothing: they are the vector environment's, and begin anew when the lane does."""
