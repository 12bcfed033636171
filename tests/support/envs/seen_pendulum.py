"""Pendulum-v1, of which only pictures are seen."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control import PendulumEnv

from millrace.protocol.arrays import Array, Bytes

SIDE = 24  # pixels
FRAMES = 3  # two show the angle and the speed, three how the speed changes
LENGTH = 0.8  # of the rod, in a picture that reaches from -1 to 1
WIDTH = 0.15


class SeenPendulum(PendulumEnv):
    """Observes the newest three pictures of the rod, [24, 24, 3] uint8, the newest one last. An episode has 200 steps."""

    def __init__(self, steps: int = 200) -> None:
        super().__init__()
        self.observation_space = spaces.Box(0, 255, (SIDE, SIDE, FRAMES), np.uint8)
        self._steps = steps
        self._step = 0
        self._frames: deque[Bytes] = deque(maxlen=FRAMES)
        axis = np.linspace(-1, 1, SIDE)
        self._x, self._y = np.meshgrid(axis, axis)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Bytes, dict[str, Any]]:
        """Begin as Pendulum does; all three pictures are the same."""
        super().reset(seed=seed)
        self._step = 0
        self._frames.extend([self._picture()] * FRAMES)
        return np.stack(self._frames, -1), {}

    def step(self, action: Array) -> tuple[Bytes, float, bool, bool, dict[str, Any]]:
        """Turn the rod, and look."""
        _, reward, terminated, _, _ = super().step(action)  # type: ignore[no-untyped-call]
        self._step += 1
        self._frames.append(self._picture())
        return np.stack(self._frames, -1), float(reward), terminated, self._step == self._steps, {}

    def _picture(self) -> Bytes:
        """White where the rod is."""
        angle = float(self.state[0])
        right = np.sin(angle)
        up = np.cos(angle)
        along = np.clip(self._x * right + self._y * up, 0, LENGTH)
        distance = np.hypot(self._x - along * right, self._y - along * up)
        picture: Bytes = (255 * np.clip(1 - distance / WIDTH, 0, 1)).astype(np.uint8)
        return picture
