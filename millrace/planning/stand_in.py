"""An environment that has the spaces of another one and does nothing: what is left is the time of millrace itself.

Rule: it shows the same observation at each step, and never ends. A step may wait, because a process that was asleep computes
more slowly for a while, as in an environment that waits. The rewards of a step are the seconds of CPU time that the worker
took since the step before.
"""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np

from millrace.protocol.policy.masks import MASK


class _WorkerHere:
    """The worker in whose process this is. All its copies share it."""

    def __init__(self) -> None:
        self._cpu_s = time.process_time()

    def cpu_s(self, wait_s: float) -> float:
        """Wait for so long. Returns the CPU time since this was last called, by any copy."""
        if wait_s:
            time.sleep(wait_s)
        before_s = self._cpu_s
        self._cpu_s = time.process_time()
        return self._cpu_s - before_s


_worker = _WorkerHere()


class StandIn(gymnasium.Env[Any, Any]):
    """In place of an environment of gymnasium's."""

    def __init__(
        self, observation_space: gymnasium.Space[Any], action_space: gymnasium.Space[Any], wait_s: float = 0.0
    ) -> None:
        """`wait_s`: for so long a step waits."""
        self.observation_space = observation_space
        self.action_space = action_space
        self._wait_s = wait_s
        self._shown = shown(observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Show the observation."""
        super().reset(seed=seed)
        return self._shown, {}

    def step(self, action: Any) -> Any:
        """Show it again."""
        return self._shown, _worker.cpu_s(self._wait_s), False, False, {}


class StandInOfAgents:
    """In place of an environment of several agents, which all act at each step."""

    metadata: dict[str, Any] = {}

    def __init__(
        self,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        wait_s: float = 0.0,
        *,
        agents: tuple[str, ...],
    ) -> None:
        """As `StandIn`."""
        self._wait_s = wait_s
        self.possible_agents = list(agents)
        self.agents = list(agents)
        self._spaces = observation_space, action_space
        self._shown = dict.fromkeys(agents, shown(observation_space))

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """Of each agent."""
        return self._spaces[0]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """Of each agent."""
        return self._spaces[1]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Show each agent the observation."""
        return self._shown, {agent: {} for agent in self.agents}

    def step(self, actions: Any) -> Any:
        """Show it again."""
        goes_on = dict.fromkeys(self.agents, False)
        cpu_s = _worker.cpu_s(self._wait_s) / len(self.agents)
        return self._shown, dict.fromkeys(self.agents, cpu_s), goes_on, goes_on, {agent: {} for agent in self.agents}

    def close(self) -> None:
        """Nothing is to do."""


def shown(space: gymnasium.Space[Any]) -> Any:
    """An observation of this space, which allows every action."""
    observation = space.sample()
    if isinstance(observation, dict) and MASK in observation:
        observation[MASK] = np.ones_like(observation[MASK])
    return observation
