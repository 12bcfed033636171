"""Environments of several agents in PettingZoo's two forms, with random histories that they write down themselves.

Who has the move, who leaves and how, and all rewards are drawn from the seed, so that histories hold every case: agents that
move twice in a row, wait for long, never move, leave early, terminated or truncated, and rewards between their moves, before
the first and after the last. `told` is what each agent lived through, in its own time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

AGENTS = ("a", "b", "c")


@dataclass
class Lived:
    """One agent's part of an episode. Entry k of each list is its k-th action, and what came of it."""

    seen: list[float] = field(default_factory=list)
    did: list[int] = field(default_factory=list)
    reward: list[float] = field(default_factory=list)
    step: list[int] = field(default_factory=list)
    """the number of the step in which its outcome came"""
    saw: list[float] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False
    total: float = 0.0
    """of all rewards, also those of no action"""


class _Told:
    """The parts that both forms share."""

    possible_agents: tuple[str, ...] = AGENTS
    metadata: dict[str, Any] = {}
    render_mode = None
    level = 1
    present = 0.9
    """How often an agent is there from the start."""

    def __init__(self, most_steps: int = 12) -> None:
        self.most_steps = most_steps
        self._spaces: dict[str, tuple[spaces.Space[Any], spaces.Space[Any]]] = {
            agent: (spaces.Box(0, np.inf, (1,), np.float32), spaces.Discrete(3)) for agent in AGENTS
        }
        self.told: list[dict[str, Lived]] = []
        self._shown: dict[str, np.ndarray] = {}
        self._generator = np.random.default_rng(0)
        self._observed = 0
        self._buffers = {agent: np.zeros(1, np.float32) for agent in AGENTS}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self._spaces[agent][1]

    def _begin(self, seed: int | None) -> None:
        if seed is not None:
            self._generator = np.random.default_rng(seed)
        self.agents = [agent for agent in AGENTS if self._generator.random() < self.present] or [AGENTS[0]]
        self.steps = 0
        self._lived = {agent: Lived() for agent in AGENTS}
        self.told.append(self._lived)
        self._pending: dict[str, tuple[np.ndarray, int]] = {}
        self._due = dict.fromkeys(AGENTS, 0.0)

    def _observation(self) -> np.ndarray:
        """Each one is a number of its own, small enough for a network."""
        self._observed += 1
        return np.array([self._observed / 64], np.float32)

    def _returned(self, agent: str) -> np.ndarray:
        """What the agent sees, in a buffer that is used again and again."""
        self._buffers[agent][:] = self._shown[agent]
        return self._buffers[agent]

    def _act(self, agent: str, seen: np.ndarray, action: Any) -> None:
        self._pending[agent] = seen, int(action)
        self._due[agent] = 0.0

    def _rewards(self, agents: list[str]) -> dict[str, float]:
        found = {}
        for agent in agents:
            found[agent] = float(np.float32(self._generator.normal())) if self._generator.random() < 0.7 else 0.0
            self._due[agent] += found[agent]
            self._lived[agent].total += found[agent]
        return found

    def _outcome(self, agent: str, saw: np.ndarray, terminated: bool, truncated: bool) -> None:
        if agent not in self._pending:
            return
        lived, (seen, action) = self._lived[agent], self._pending.pop(agent)
        lived.seen.append(float(seen[0]))
        lived.did.append(action)
        lived.reward.append(self._due[agent])
        lived.step.append(self.steps - 1)
        lived.saw.append(float(saw[0]))
        lived.terminated, lived.truncated = terminated, truncated

    def _end(self) -> tuple[bool, bool]:
        """Terminated, truncated or both."""
        return ((True, False), (False, True), (True, True))[self._generator.integers(3)]

    def render(self) -> None:
        return None

    def close(self) -> None:
        pass


class RandomGame(_Told, AECEnv[str, Any, Any]):  # type: ignore[misc]
    """One agent acts at a time: PettingZoo's AEC form. Its first rewards may come with the reset."""

    rewards_at_reset = 0.2

    def reset(self, seed: int | None = None, options: Any = None) -> None:
        self._begin(seed)
        self._buffers = dict.fromkeys(AGENTS, np.zeros(1, np.float32))  # one for all
        early = self._generator.random() < self.rewards_at_reset
        self.rewards = self._rewards(self.agents) if early else dict.fromkeys(self.agents, 0.0)
        self._cumulative = dict(self.rewards)
        self.terminations, self.truncations = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict[str, Any]] = {agent: {"steps": 0} for agent in self.agents}
        self._choose()

    def _choose(self) -> None:
        self.agent_selection = str(self._generator.choice(self.agents))
        self._show(self.agent_selection)

    def _show(self, agent: str) -> None:
        self._shown[agent] = self._observation()
        self._outcome(agent, self._shown[agent], self.terminations[agent], self.truncations[agent])

    def last(self, observe: bool = True) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        agent = self.agent_selection
        ended = self.terminations[agent], self.truncations[agent]
        return self._returned(agent) if observe else None, self._cumulative[agent], *ended, self.infos[agent]

    def step(self, action: Any) -> None:
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            assert action is None
            self.agents.remove(agent)
            for of_agents in (self.terminations, self.truncations, self.infos):
                del of_agents[agent]
            self.rewards = dict.fromkeys(self.agents, 0.0)
        else:
            self._act(agent, self._shown[agent], action)
            self._cumulative[agent] = 0.0
            self.rewards = self._rewards(self.agents)
            for who, reward in self.rewards.items():
                self._cumulative[who] += reward
            self.steps += 1
            self.infos = {who: {"steps": self.steps} for who in self.agents}
            over = self.steps >= self.most_steps or self._generator.random() < 0.05
            for who in self.agents:
                if over or self._generator.random() < 0.06:
                    self.terminations[who], self.truncations[who] = self._end()
        gone = [who for who in self.agents if self.terminations[who] or self.truncations[who]]
        if gone:
            self.agent_selection = gone[0]
            self._show(gone[0])
        elif self.agents:
            self._choose()


class RandomCrowd(_Told, ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """All agents that are there act at the same time: PettingZoo's parallel form. Some come later."""

    leaves = 0.08

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self._begin(seed)
        self._was_here = set(self.agents)
        self._shown = {agent: self._observation() for agent in self.agents}
        return {agent: self._returned(agent) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        assert list(actions) == [agent for agent in AGENTS if agent in self.agents]
        for agent, action in actions.items():
            self._act(agent, self._shown[agent], action)
        outside = [agent for agent in AGENTS if agent not in self.agents and self._generator.random() < 0.1]
        rewards = self._rewards([*self.agents, *outside])
        self.steps += 1
        over = self.steps >= self.most_steps or self._generator.random() < 0.05
        ends = {
            agent: self._end() if over or self._generator.random() < self.leaves else (False, False) for agent in self.agents
        }
        shown = {}
        for agent, (terminated, truncated) in ends.items():
            shown[agent] = self._shown[agent] = self._observation()
            self._outcome(agent, self._shown[agent], terminated, truncated)
        self.agents = [agent for agent in self.agents if not any(ends[agent])]
        late = [agent for agent in AGENTS if agent not in self._was_here]
        if self.agents and late and self._generator.random() < 0.3:
            self._was_here.add(late[0])
            self.agents = [agent for agent in AGENTS if agent in (*self.agents, late[0])]
            ends[late[0]] = False, False
            shown[late[0]] = self._shown[late[0]] = self._observation()
        ended = [{agent: both[k] for agent, both in ends.items()} for k in (0, 1)]
        return (
            {agent: self._returned(agent) for agent in shown},
            rewards,
            *ended,
            {agent: {"steps": self.steps} for agent in shown},
        )


class Unequal(RandomCrowd):
    """One agent has more actions than the others."""

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(3 if agent == "a" else 4)


MOVES = {"short": 3, "long": 6}
CHAIN_REWARD = {"short": (1.0, -1.0, 2.0), "long": (0.5, 0.0, 1.0, -2.0, 0.0, 3.0)}


class _Chain:
    """Each agent makes a number of moves, then it leaves. What it does makes no difference, so its values are known."""

    possible_agents = tuple(MOVES)
    made: dict[str, int]
    metadata: dict[str, Any] = {}
    render_mode = None

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(0, 1, (sum(MOVES.values()),), np.float32)

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(2)

    def observe(self, agent: str) -> np.ndarray:
        """Who it is and how many moves it has made; all zeros when it has made them all."""
        found = np.zeros(sum(MOVES.values()), np.float32)
        if (made := self.made[agent]) < MOVES[agent]:
            found[(0 if agent == "short" else MOVES["short"]) + made] = 1
        return found

    def close(self) -> None:
        pass


class ChainCrowd(_Chain):
    """Both move at the same time."""

    def state(self) -> np.ndarray:
        """How many moves each has made."""
        return np.array([self.made[agent] for agent in MOVES], np.float32)

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.agents, self.made = list(MOVES), dict.fromkeys(MOVES, 0)
        return {agent: self.observe(agent) for agent in self.agents}, {}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        rewards = {agent: CHAIN_REWARD[agent][self.made[agent]] for agent in actions}
        for agent in actions:
            self.made[agent] += 1
        over = {agent: self.made[agent] == MOVES[agent] for agent in actions}
        self.agents = [agent for agent in self.agents if not over[agent]]
        return {agent: self.observe(agent) for agent in actions}, rewards, over, dict.fromkeys(actions, False), {}


class ChainGame(_Chain):
    """They take turns until one has left."""

    def agent_iter(self) -> None:
        """Present in this form alone."""

    def reset(self, seed: int | None = None, options: Any = None) -> None:
        self.agents, self.made = list(MOVES), dict.fromkeys(MOVES, 0)
        self.due = dict.fromkeys(MOVES, 0.0)
        self.agent_selection = "short"

    def _over(self, agent: str) -> bool:
        return self.made[agent] == MOVES[agent]

    def last(self) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        agent = self.agent_selection
        return self.observe(agent), self.due[agent], self._over(agent), False, {}

    def step(self, action: Any) -> None:
        agent = self.agent_selection
        if self._over(agent):
            self.agents.remove(agent)
        else:
            self.due[agent] = CHAIN_REWARD[agent][self.made[agent]]
            self.made[agent] += 1
        others = [each for each in self.agents if each != agent]
        self.agent_selection = others[0] if others else agent


def values_of_the_chain(gamma: float) -> list[float]:
    """The value of each of the chain's observations, by the place of its 1."""
    found: list[float] = []
    for rewards in CHAIN_REWARD.values():
        found += [sum(gamma**j * reward for j, reward in enumerate(rewards[k:])) for k in range(len(rewards))]
    return found


class RandomTeam(RandomCrowd):
    """All agents act at every step of an episode."""

    present, leaves = 1.0, 0.0


class RockPaperScissors(ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """One throw. Its only equilibrium is to throw each with probability 1/3."""

    metadata: dict[str, Any] = {}
    render_mode = None

    def __init__(self) -> None:
        self.possible_agents = ["left", "right"]

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(0, 1, (1,))

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(3)

    def _seen(self) -> dict[str, Any]:
        return {agent: np.ones(1, np.float32) for agent in self.possible_agents}

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.agents = self.possible_agents[:]
        return self._seen(), {}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        won = (0, 1, -1)[(int(actions["left"]) - int(actions["right"])) % 3]
        self.agents = []
        yes, no = dict.fromkeys(self.possible_agents, True), dict.fromkeys(self.possible_agents, False)
        return self._seen(), {"left": float(won), "right": -float(won)}, yes, no, {}

    def render(self) -> None: ...

    def close(self) -> None: ...
