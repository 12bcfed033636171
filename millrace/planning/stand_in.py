"""An environment that has the spaces of another one and does nothing, so that only millrace's own time is measured.

Rule: it returns the same observation at each step, and its episode never ends. If the real environment's steps wait, the
stand-in's steps wait too, because a process computes more slowly for a while after it has slept. A step's rewards add up to
the CPU time in seconds that the worker has used since the previous step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from millrace.protocol.envs.spaces import make_flatten, make_unflatten
from millrace.protocol.policy.masks import MASK


class _WorkerHere:
    """The CPU time of this worker's process, which all its env copies share."""

    def __init__(self) -> None:
        self._cpu_s = time.process_time()

    def cpu_s(self, wait_s: float) -> float:
        """Wait for `wait_s`. Returns the CPU time of the process since the last call by any copy."""
        if wait_s:
            time.sleep(wait_s)
        before_s = self._cpu_s
        self._cpu_s = time.process_time()
        return self._cpu_s - before_s


_worker = _WorkerHere()


class StandIn(gymnasium.Env[Any, Any]):
    """Stands in for a gymnasium environment."""

    def __init__(
        self, observation_space: gymnasium.Space[Any], action_space: gymnasium.Space[Any], wait_s: float = 0.0
    ) -> None:
        """`wait_s`: how long a step waits."""
        self.observation_space = observation_space
        self.action_space = action_space
        self._wait_s = wait_s
        self._shown = shown(observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Return the observation."""
        super().reset(seed=seed)
        return self._shown, {}

    def step(self, action: Any) -> Any:
        """Return the same observation again, and the CPU time as the reward."""
        return self._shown, _worker.cpu_s(self._wait_s), False, False, {}


class StandInOfAgents:
    """Stands in for an environment of several agents, which all act at each step."""

    metadata: dict[str, Any] = {}

    def __init__(
        self,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        wait_s: float = 0.0,
        *,
        agents: tuple[str, ...],
    ) -> None:
        """`wait_s`: how long a step waits."""
        self._wait_s = wait_s
        self.possible_agents = list(agents)
        self.agents = list(agents)
        self._spaces = observation_space, action_space
        self._shown = dict.fromkeys(agents, shown(observation_space))

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """The observation space, which is the same for all agents."""
        return self._spaces[0]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """The action space, which is the same for all agents."""
        return self._spaces[1]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Return the observation for each agent."""
        return self._shown, {agent: {} for agent in self.agents}

    def step(self, actions: Any) -> Any:
        """Return the same observation again. The agents' rewards add up to the CPU time."""
        goes_on = dict.fromkeys(self.agents, False)
        cpu_s = _worker.cpu_s(self._wait_s) / len(self.agents)
        return self._shown, dict.fromkeys(self.agents, cpu_s), goes_on, goes_on, {agent: {} for agent in self.agents}

    def close(self) -> None:
        """Do nothing."""


def shown(space: gymnasium.Space[Any]) -> Any:
    """A random observation of this space. If it has an action mask, the mask allows every action.

    Its floats are as close to 0 as a typical environment's, because bounds may be too large to be informative.
    """
    observation = with_float_boxes(space, _with_small_floats).sample()
    if isinstance(space, spaces.Dict) and MASK in space.spaces:
        observation[MASK] = _ones(space.spaces[MASK])
    return observation


def with_float_boxes(space: gymnasium.Space[Any], change: Callable[[spaces.Box], spaces.Box]) -> gymnasium.Space[Any]:
    """The space with each Box of floats changed."""
    match space:
        case spaces.Dict():
            return spaces.Dict([(key, with_float_boxes(inner, change)) for key, inner in space.spaces.items()])
        case spaces.Tuple():
            return spaces.Tuple([with_float_boxes(inner, change) for inner in space.spaces])
        case spaces.Box() if space.dtype.kind == "f":
            return change(space)
        case _:
            return space


def _with_small_floats(box: spaces.Box) -> spaces.Box:
    """The part of the space whose floats differ by at most 1 from 0, or from the bound that is nearest to 0."""
    nearest = np.clip(np.zeros_like(box.low), box.low, box.high)
    kind: Any = box.dtype.type
    return spaces.Box(np.maximum(box.low, nearest - 1), np.minimum(box.high, nearest + 1), dtype=kind)


def _ones(mask: gymnasium.Space[Any]) -> Any:
    """A mask of this space that allows every action."""
    parts = make_flatten(mask)(mask.sample())
    return make_unflatten(mask)([np.ones_like(part) for part in parts])
