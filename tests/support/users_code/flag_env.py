"""An environment whose observation is bytes, or other small integers, of which one is 1."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces


class Flags(gymnasium.Env[npt.NDArray[Any], Any]):
    """Ten steps. One of four flags is up, and the right action is its number."""

    action_space = spaces.Discrete(4)

    def __init__(self, dtype: str = "uint8") -> None:
        self.observation_space = spaces.Box(0, 1, (4,), np.dtype(dtype).type)

    def _observation(self) -> npt.NDArray[Any]:
        self._up = int(self.np_random.integers(4))
        return np.asarray(np.arange(4) == self._up, self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[npt.NDArray[Any], dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[npt.NDArray[Any], float, bool, bool, dict[str, Any]]:
        reward, self._steps = float(action == self._up), self._steps + 1
        return self._observation(), reward, False, self._steps == 10, {}
