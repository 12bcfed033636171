"""A Pendulum that hides its velocity: which torque is right can only be known from earlier observations."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

Seen = npt.NDArray[np.float32]


class BlindPendulum(gymnasium.ObservationWrapper[Seen, Any, Seen]):
    """Pendulum-v1 with observations [2] float32: cosine and sine of its angle."""

    def __init__(self) -> None:
        super().__init__(gymnasium.make("Pendulum-v1"))
        self.observation_space = spaces.Box(-1, 1, (2,), np.float32)

    def observation(self, observation: Seen) -> Seen:
        """Without the velocity, which stands last."""
        return observation[:2]
