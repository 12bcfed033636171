"""An environment that looks like a preprocessed Atari game and takes as much time, for benchmarks. It needs no emulator.

A step draws four screens of 210 × 160 pixels, each with a ball on moving noise. It converts them to grayscale, takes the
maximum of the last two, scales it to 84 × 84, and stacks the last four such frames: [84, 84, 4] bytes, about 0.4 ms of work.
Episodes last 1,000 steps.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from millrace.protocol.arrays import Bytes

SKIP = 4  # number of screens in a step
_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
_ROWS, _COLUMNS = np.ix_(np.linspace(0, 209, 84).astype(int), np.linspace(0, 159, 84).astype(int))


class Frames(gymnasium.Env[Bytes, Any]):
    """Frames of a ball that moves according to six actions. Rewards are 0."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(0, 255, (84, 84, 4), np.uint8)
        self.action_space = spaces.Discrete(6)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Bytes, dict[str, Any]]:
        """Begin with four empty frames."""
        super().reset(seed=seed)
        self._screen = self.np_random.integers(256, size=(210, 160, 3), dtype=np.uint8)
        self._frames = [np.zeros((84, 84), np.uint8)] * 4
        self._at = 0
        return np.stack(self._frames, -1), {}

    def step(self, action: Any) -> tuple[Bytes, float, bool, bool, dict[str, Any]]:
        """Draw four screens, and return the last four frames."""
        grey = [self._draw(int(action)) for _ in range(SKIP)]
        self._frames = [*self._frames[1:], np.maximum(grey[-1], grey[-2])[_ROWS, _COLUMNS]]
        return np.stack(self._frames, -1), 0.0, False, self._at >= 1_000 * SKIP, {}

    def _draw(self, action: int) -> Bytes:
        """The next screen [210, 160], in grayscale."""
        self._at += 1
        screen = self._screen = np.roll(self._screen, (1, 1), (0, 1))
        screen[..., 0] ^= self.np_random.integers(256, size=(210, 160), dtype=np.uint8)
        screen[self._at % 200 :][:8, 20 * action :][:, :8] = 255
        return (screen @ _LUMINANCE).astype(np.uint8)


gymnasium.register(id="Frames-v0", entry_point=f"{__name__}:Frames")
