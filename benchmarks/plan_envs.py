"""Eight environments for `benchmarks/plan.py`, each slow or fast in a different way, such as `benchmarks.plan_envs:Waits`.

A step that waits sleeps. A step that computes keeps its core busy for the given CPU time.
"""

from __future__ import annotations

import math
import os
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

STEP_S = 0.005
RESET_S = 0.3
EPISODE = 100  # number of steps
LARGE = 4000  # size of a large observation


class _Timed(gymnasium.Env[Any, Any]):
    """Steps take `step_s` and resets `reset_s`, without using the CPU. Observations have 4 numbers and actions 2."""

    numbers = 4
    step_s = STEP_S
    reset_s = 0.0

    def __init__(self) -> None:
        self.observation_space = Box(-1.0, 1.0, (self.numbers,), np.float32)
        self.action_space: gymnasium.Space[Any] = Box(-1.0, 1.0, (2,), np.float32)
        self._left = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        time.sleep(self.reset_s)
        self._left = EPISODE
        return self.observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.take_time()
        self._left -= 1
        return self.observation(), float(np.sum(action)), False, self._left == 0, {}

    def take_time(self) -> None:
        """Take the time of a step."""
        time.sleep(self.step_s)

    def observation(self) -> Any:
        """A new random observation."""
        return self.np_random.uniform(-1, 1, self.numbers).astype(np.float32)


class Fast(_Timed):
    """A step takes microseconds."""

    def take_time(self) -> None:
        """Take no time."""


class Waits(_Timed):
    """A step waits for 5 ms."""


class Computes(_Timed):
    """A step computes for 20 ms, so that an algorithm with a replay buffer is chosen."""

    step_s = 0.02

    def take_time(self) -> None:
        """Keep the core busy."""
        end_s = time.thread_time() + self.step_s
        while time.thread_time() < end_s:
            pass


class Uneven(_Timed):
    """A step waits for 5 ms on average (lognormal, sigma 1)."""

    def take_time(self) -> None:
        """Sleep for a random time."""
        time.sleep(float(self.np_random.lognormal(math.log(self.step_s) - 0.5, 1.0)))


class LongResets(_Timed):
    """A reset waits for 300 ms, after 100 steps of 5 ms."""

    reset_s = RESET_S


class LargeObservations(_Timed):
    """An observation has 4,000 numbers, and a step waits for 5 ms."""

    numbers = LARGE


class NotDeterministic(_Timed):
    """Observations don't depend on the seed. Actions are discrete, and a step waits for 5 ms."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = Discrete(3)

    def observation(self) -> Any:
        """An observation made of the system's random numbers."""
        return np.frombuffer(os.urandom(self.numbers), np.uint8).astype(np.float32) / 128 - 1


class Agents:
    """Three agents, in PettingZoo's interface (`ParallelEnv`). A step waits for 5 ms."""

    metadata: dict[str, Any] = {"name": "agents"}
    possible_agents = ("a", "b", "c")

    def __init__(self) -> None:
        self.agents: list[str] = []
        self._spaces = Box(-1.0, 1.0, (4,), np.float32), Discrete(3)
        self._random = np.random.default_rng(0)
        self._left = 0

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """The observation space, which is the same for all agents."""
        return self._spaces[0]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """The action space, which is the same for all agents."""
        return self._spaces[1]

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        if seed is not None:
            self._random = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self._left = EPISODE
        return self._shown(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        """Step with the actions of all agents."""
        time.sleep(STEP_S)
        self._left -= 1
        over = dict.fromkeys(self.agents, self._left == 0)
        shown = self._shown()
        answer: tuple[Any, ...] = (
            shown,
            dict.fromkeys(self.agents, 1.0),
            dict.fromkeys(self.agents, False),
            over,
            {agent: {} for agent in self.agents},
        )
        if self._left == 0:
            self.agents = []
        return answer

    def close(self) -> None:
        """Do nothing."""

    def _shown(self) -> dict[str, Any]:
        return {agent: self._random.uniform(-1, 1, 4).astype(np.float32) for agent in self.agents}
