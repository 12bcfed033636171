"""An environment whose reward depends on what its actor does not see."""

from __future__ import annotations

from typing import Any, ClassVar

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


class Gusts:
    """Two agents, 20 steps. Each gets 1 for action 1, and 10 times the episode's gust, which `state()` alone shows."""

    possible_agents = ("left", "right")
    metadata: ClassVar[dict[str, Any]] = {}
    render_mode = None
    state_space = spaces.Box(-1, 1, (1,), np.float32)

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(-1, 1, (2,), np.float32)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(4)

    def state(self) -> np.ndarray:
        return np.array([self.gust], np.float32)

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        if seed is not None:
            self._generator = np.random.default_rng(seed)
        self.agents, self.steps, self.right = list(self.possible_agents), 0, 0
        self.gust = self._generator.choice((-1.0, 1.0))
        return dict.fromkeys(self.agents, np.zeros(2, np.float32)), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        rewards = {agent: 10 * self.gust + (action == 1) for agent, action in actions.items()}
        self.right += sum(int(action == 1) for action in actions.values())
        self.steps += 1
        over = dict.fromkeys(actions, self.steps == 20)
        infos = {agent: {"right": self.right / 40} for agent in actions}
        self.agents = [] if self.steps == 20 else self.agents
        return dict.fromkeys(actions, np.zeros(2, np.float32)), rewards, over, dict.fromkeys(actions, False), infos

    def close(self) -> None:
        pass
