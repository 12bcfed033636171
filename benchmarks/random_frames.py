"""An environment of random frames, which take almost no time to make: `benchmarks.random_frames:RandomFrames-v0`."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from millrace.protocol.arrays import Bytes


class RandomFrames(gymnasium.Env[Bytes, Any]):
    """Shows the same eight random frames in a loop. It has six actions. Rewards are 0."""

    def __init__(self, side: int = 84, channels: int = 4) -> None:
        """Frames are `side` × `side` pixels with this number of channels, uint8."""
        shape = (side, side, channels)
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)
        self.action_space = spaces.Discrete(6)
        self._frames = np.random.default_rng(0).integers(0, 256, (8, *shape), np.uint8)
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Bytes, dict[str, Any]]:
        """Show the first frame."""
        super().reset(seed=seed)
        self._steps = 0
        return self._frames[0].copy(), {}

    def step(self, action: Any) -> tuple[Bytes, float, bool, bool, dict[str, Any]]:
        """Show the next frame. An episode has 100 steps."""
        self._steps += 1
        return self._frames[self._steps % 8].copy(), 0.0, False, self._steps >= 100, {}


gymnasium.register(id="RandomFrames-v0", entry_point=f"{__name__}:RandomFrames")
