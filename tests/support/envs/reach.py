"""A task with goals, as gymnasium-robotics has them. It imports nothing of millrace.

Importing this file registers it: `gymnasium.make("tests.support.envs.reach:Reach-v0", limit=50)`.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

Floats = npt.NDArray[np.float32]
Info = dict[str, Any]
MOVES = ((1, 0), (-1, 0), (0, 1), (0, -1))


class Reach(gymnasium.Env[Any, Any]):
    """A point in a square, which has to come to a goal; observations and `compute_reward` as gymnasium-robotics has them.

    It starts in the middle, and moves at most `step` a side in a step. Episodes are truncated after `limit` steps; with
    `ends`, they end at the goal. The reward is `sparse`: 0 if the goal is `within` this distance, else -1; `success`: 1 or
    0; or `dense`: minus the distance. `scale` multiplies all.
    """

    def __init__(
        self,
        limit: int = 20,
        step: float = 0.1,
        within: float = 0.1,
        reward: str = "sparse",
        ends: bool = False,
        discrete: bool = False,
        scale: float = 1.0,
    ) -> None:
        goal = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Dict(observation=goal, achieved_goal=goal, desired_goal=goal)
        self.action_space = spaces.Discrete(4) if discrete else spaces.Box(-1, 1, (2,), np.float32)
        self._limit = limit
        self._step = step
        self._within = within
        self._reward = reward
        self._ends = ends
        self._scale = scale
        self._at = self._goal = np.zeros(2)
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[dict[str, Floats], Info]:
        """Begin in the middle; the goal may be anywhere that is at least half a side away."""
        super().reset(seed=seed)
        self._at = np.zeros(2)
        self._goal = self.np_random.uniform(0.5, 1, 2) * self.np_random.choice([-1, 1], 2)
        self._steps = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[dict[str, Floats], float, bool, bool, Info]:
        """Move."""
        move = MOVES[int(action)] if isinstance(self.action_space, spaces.Discrete) else np.clip(action, -1, 1)
        self._at = np.clip(self._at + self._step * np.asarray(move, np.float64), -1, 1)
        self._steps += 1
        reward = self._scale * self.compute_reward(self._at, self._goal)
        terminated = self._ends and float(np.linalg.norm(self._at - self._goal)) <= self._within
        return self._observation(), reward, terminated, self._steps >= self._limit, {"success": self._is_there()}

    def compute_reward(self, achieved: npt.NDArray[Any], desired: npt.NDArray[Any]) -> float:
        """Computed in float64, before the goals are rounded to what observations hold."""
        apart = float(np.linalg.norm(achieved - desired))
        if self._reward == "dense":
            return -apart
        return float(apart <= self._within) - (self._reward == "sparse")

    def _is_there(self) -> float:
        return float(np.linalg.norm(self._at - self._goal) <= self._within)

    def _observation(self) -> dict[str, Floats]:
        at = self._at.astype(np.float32)
        return {"observation": at, "achieved_goal": at.copy(), "desired_goal": self._goal.astype(np.float32)}


gymnasium.register(id="Reach-v0", entry_point=f"{__name__}:Reach")
