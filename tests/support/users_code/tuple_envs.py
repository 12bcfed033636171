"""A gymnasium environment of several agents, as rware, lbforaging and vmas have them: spaces and rewards are tuples."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class Lamps(gymnasium.Env[Any, Any]):
    """Each agent sees two numbers, and chooses a switch and a brightness. Its reward depends on all of them.

    `rewards`: `list`, or `array`, or `sum` for one number. An episode ends at random.
    """

    def __init__(self, agents: int = 2, rewards: str = "list") -> None:
        self.observation_space = spaces.Tuple([spaces.Box(-1, 1, (2,), np.float32)] * agents)
        self.action_space: Any = spaces.Tuple(
            [spaces.Tuple([spaces.Discrete(3), spaces.Box(-1, 1, (1,), np.float32)])] * agents
        )
        self._agents, self._rewards = agents, rewards

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._next(), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if not self.action_space.contains(action):
            raise ValueError(f"action: expected one of {self.action_space}, got {action!r}")
        rewards = [float(seen.sum() + choice + number[0]) for seen, (choice, number) in zip(self._seen, action, strict=True)]
        given = {"list": rewards, "array": np.array(rewards), "sum": sum(rewards)}[self._rewards]
        ended, late = self.np_random.random(2) < 0.1
        return self._next(), given, bool(ended), bool(late and not ended), {}

    def _next(self) -> Any:
        self._seen = tuple(self.np_random.uniform(-1, 1, 2).astype(np.float32) for _ in range(self._agents))
        return self._seen


gymnasium.register("Lamps-v0", f"{__name__}:Lamps")
