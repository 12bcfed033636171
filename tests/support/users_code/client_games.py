"""Tag-v0 and Nim-v0 of `clients/cpp/examples` in PettingZoo's two forms.

Each episode begins so that the agent who acts first sees the next of `starts`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces

from millrace.protocol.arrays import Array


class Tag:
    """All agents act at the same time; a runner who is caught leaves."""

    possible_agents = ("chaser", "runner_0", "runner_1")

    def __init__(self, starts: Iterator[Array]) -> None:
        self._starts = starts

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(-1, 1, (3,), np.float32)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(3)

    def reset(self, seed: int | None = None) -> tuple[dict[str, Array], dict[str, Any]]:
        self.agents, self._steps = list(self.possible_agents), 0
        self._at = [0, *(round(6 * float(apart)) % 12 for apart in next(self._starts)[1:])]
        return {agent: self._seen(agent) for agent in self.agents}, {}

    def _seen(self, agent: str) -> Array:
        """Who it is, and how far the others are; 0: caught."""
        found, self_at = [1.0 if agent == "chaser" else -1.0], self._at[self.possible_agents.index(agent)]
        for other, at in zip(self.possible_agents, self._at, strict=True):
            if other != agent:
                found.append(((at - self_at + 5) % 12 - 5) / 6 if other in self.agents else 0.0)
        return np.array(found, np.float32)

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        self._steps += 1
        for agent, action in actions.items():
            self._at[self.possible_agents.index(agent)] += int(action) - 1
        at = dict(zip(self.possible_agents, self._at, strict=True))
        caught = {agent: agent != "chaser" and (at[agent] - at["chaser"]) % 12 == 0 for agent in actions}
        reward = {agent: -1.0 if caught[agent] else 0.1 for agent in actions} | {"chaser": float(sum(caught.values()))}
        self.agents = [agent for agent in self.agents if not caught[agent]]
        caught["chaser"] = self.agents == ["chaser"]
        late = {agent: self._steps == 30 and not caught[agent] for agent in actions}
        seen = {agent: self._seen(agent) for agent in actions}
        if self._steps == 30 or caught["chaser"]:
            self.agents = []
        return seen, reward, caught, late, {}


class Nim:
    """Two agents take turns; who takes the last stick wins."""

    possible_agents = ("first", "second")

    def __init__(self, starts: Iterator[Array]) -> None:
        self._starts = starts

    def agent_iter(self) -> None:
        """Present in this form alone."""

    def observation_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(21)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(3, start=1)

    def reset(self, seed: int | None = None) -> None:
        self.agents, self.agent_selection = list(self.possible_agents), "first"
        self._sticks, self._reward = int(next(self._starts)), dict.fromkeys(self.possible_agents, 0.0)

    def last(self) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.int64(self._sticks), self._reward[self.agent_selection], self._sticks == 0, False, {}

    def step(self, action: Any) -> None:
        mover = self.agent_selection
        self.agent_selection = "second" if mover == "first" else "first"
        if self._sticks == 0:
            self.agents.remove(mover)
            return
        self._sticks -= min(self._sticks, int(action))
        if self._sticks == 0:
            self._reward = {mover: 1.0, self.agent_selection: -1.0}
