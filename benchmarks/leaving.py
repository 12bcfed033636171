"""A task whose agents leave one by one: each walks to the exit of a grid, gets 1 there, and pays for each step until then.

Two agents can't be in the same cell, so they get in each other's way. An agent observes the way to the exit, its own
position, and which of the four adjacent cells are taken or outside the grid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

SIZE = 7
LENGTH = 60
MOVES = np.array([(0, 1), (0, -1), (1, 0), (-1, 0)])
COST = 0.02


class Exit(ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """Four agents on a grid of SIZE × SIZE."""

    metadata: dict[str, Any] = {"name": "exit"}
    render_mode = None
    possible_agents = [f"agent_{number}" for number in range(4)]

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(-1, 1, (8,), np.float32)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(len(MOVES))

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        if seed is not None or not hasattr(self, "_rng"):
            self._rng = np.random.default_rng(seed)
        self.agents = [*self.possible_agents]
        self._steps = 0
        cells = self._rng.choice(SIZE * SIZE, 1 + len(self.agents), replace=False)
        self._exit, *places = [np.array(divmod(int(cell), SIZE)) for cell in cells]
        self._at = dict(zip(self.agents, places, strict=True))
        return {agent: self._seen(agent) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        self._steps += 1
        acted = self.agents
        for agent in acted:
            there = self._at[agent] + MOVES[actions[agent]]
            if self._free(there):
                self._at[agent] = there
            if (self._at[agent] == self._exit).all():
                self._at[agent] = np.array((-9, -9))
        left = {agent: bool(self._at[agent][0] < 0) for agent in acted}
        late = {agent: self._steps == LENGTH and not left[agent] for agent in acted}
        self.agents = [agent for agent in acted if not left[agent] and not late[agent]]
        rewards = {agent: float(left[agent]) - COST for agent in acted}
        return {agent: self._seen(agent) for agent in acted}, rewards, left, late, {agent: {} for agent in acted}

    def _free(self, cell: Any) -> bool:
        return bool((cell >= 0).all() and (cell < SIZE).all() and not any((at == cell).all() for at in self._at.values()))

    def _seen(self, agent: str) -> Any:
        at = self._at[agent]
        if at[0] < 0:
            return np.zeros(8, np.float32)
        around = [not self._free(at + move) for move in MOVES]
        return np.array([*(self._exit - at) / SIZE, *at / SIZE, *around], np.float32)
