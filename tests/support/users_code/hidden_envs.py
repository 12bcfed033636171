"""An environment whose reward depends on what its actor does not see."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

REWARDS = (-1.0, 0.0, 2.0, 5.0)


class Hidden(gymnasium.Env[dict[str, Any], Any]):
    """One step: the reward is that of the hidden number. `hidden` comes first, so that its order is not the rows' order."""

    observation_space = spaces.Dict(
        [("hidden", spaces.Discrete(len(REWARDS))), ("seen", spaces.Box(-1, 1, (2,), np.float32))]
    )
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        self.number = int(self.np_random.integers(len(REWARDS)))
        return self._observation(), {}

    def _observation(self) -> dict[str, Any]:
        return {"hidden": np.int64(self.number), "seen": np.array([0.5, -0.5], np.float32)}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        return self._observation(), REWARDS[self.number], True, False, {}
