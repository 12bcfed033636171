"""Environments that report facts in `info` at the end of an episode, and one whose level a curriculum sets."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete


class Facts(gymnasium.Env[Any, Any]):
    """Its nth episode takes 3 + n % 4 steps. Then info says whether n is even, and, unless n % 3 is 0, n as distance.

    Each step reports `distance` 99, which counts only at the end. With `text`, the fact `name` is no number.
    """

    observation_space = Box(-1.0, 1.0, (2,))
    action_space = Discrete(2)

    def __init__(self, text: bool = False) -> None:
        self.text, self.episode, self.t, self.level = text, -1, 0, 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode, self.t = 0 if seed is not None else self.episode + 1, 0
        return self._observation(), {"distance": 99.0}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        ended = self.t >= 3 + self.episode % 4
        info: dict[str, Any] = {"distance": 99.0}
        if ended:
            info = {"is_success": self.episode % 2 == 0, "level": self.level}
            if self.episode % 3:
                info["distance"] = np.float32(self.episode)
            if self.text:
                info["name"] = "north"
        by_clock = ended and self.episode % 5 == 0
        return self._observation(), float(action) + self.level, ended and not by_clock, by_clock, info

    def _observation(self) -> Any:
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)


gymnasium.register("Facts-v0", f"{__name__}:Facts")


class Unlike(Facts):
    """Its infos can't be merged with those of another copy: a key has values of different types and shapes."""

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, _ = super().step(action)
        ended = terminated or truncated
        contacts = np.zeros(self.np_random.integers(1, 4))
        info = {"score": self.t + 0.75 if ended else 0, "event": "end" if ended else 0, "contacts": contacts}
        return observation, reward, terminated, truncated, info


gymnasium.register("Unlike-v0", f"{__name__}:Unlike")
