"""`millrace:TupleOfAgents`, a wrapper for multi-agent gymnasium environments whose spaces are Tuples.

Rule: element i of the observations, actions and rewards belongs to agent i. An episode ends for all agents at once, when
each of them has been terminated or truncated, because some environments set an agent's flag only in the agent's last step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from millrace.protocol.arrays import Bools
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.answers import WrongAnswer, reset_answer, wrong_step
from millrace.protocol.errors import UsageError, safe_repr


def agents_in_tuples(observation: gymnasium.Space[Any], action: gymnasium.Space[Any]) -> int:
    """The number of agents that these spaces suggest: their length if both are Tuples of equal length, else 0."""
    count = len(_elements(action))
    return count if count == len(_elements(observation)) else 0


def _elements(space: gymnasium.Space[Any]) -> tuple[gymnasium.Space[Any], ...]:
    """The elements of a Tuple; empty for any other space."""
    return space.spaces if isinstance(space, spaces.Tuple) else ()


class TupleOfAgents:
    """Wraps a gymnasium environment that takes and returns tuples with an element for each agent.

    Environments such as those of rware, lbforaging and vmas have this form. The wrapper gives them PettingZoo's parallel
    interface, so that each element is trained as an agent: `--wrappers millrace:TupleOfAgents`. Without the wrapper, the
    Tuple is one action of one agent, and the environment must return one reward.

    >>> import gymnasium, millrace
    >>> class Lights(gymnasium.Env):
    ...     observation_space = gymnasium.spaces.Tuple([gymnasium.spaces.Discrete(2)] * 2)
    ...     action_space = gymnasium.spaces.Tuple([gymnasium.spaces.Discrete(2)] * 2)
    ...
    ...     def reset(self, seed=None, options=None):
    ...         return (0, 1), {}
    ...
    ...     def step(self, action):
    ...         return (0, 1), [1.0, 0.0], True, False, {}
    >>> env = millrace.TupleOfAgents(Lights())
    >>> env.possible_agents
    ['agent_0', 'agent_1']
    >>> env.reset()
    ({'agent_0': 0, 'agent_1': 1}, {'agent_0': {}, 'agent_1': {}})
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        """Raises `UsageError` unless the observation and the action space are Tuples of equal length."""
        observation = env.observation_space
        action = env.action_space
        count = agents_in_tuples(observation, action)
        if not count:
            raise UsageError(
                "TupleOfAgents: expected an observation space and an action space that are Tuples with an element for each "
                f"agent, got {observation} and {action}"
            )
        self.env = env
        self.metadata = env.metadata
        self.render_mode = env.render_mode
        self.possible_agents = [f"agent_{number}" for number in range(count)]
        self.agents: list[str] = []
        self._ended = self._not_ended()
        self._observation_spaces = dict(zip(self.possible_agents, _elements(observation), strict=True))
        self._action_spaces = dict(zip(self.possible_agents, _elements(action), strict=True))

    @property
    def unwrapped(self) -> gymnasium.Env[Any, Any]:
        """The environment inside all wrappers."""
        return self.env.unwrapped

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """The agent's element of the observation space."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """The agent's element of the action space."""
        return self._action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode with all agents. Returns observations and infos, by agent."""
        observations, info = reset_answer(self.env.reset(seed=seed, options=options))
        self.agents = list(self.possible_agents)
        self._ended = self._not_ended()
        return self._by_agent("observation", observations), dict.fromkeys(self.possible_agents, info)

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        """Step with the actions of all agents. Returns observations, rewards, terminated, truncated and infos, by agent."""
        answer = self.env.step(tuple(actions[agent] for agent in self.possible_agents))
        try:
            observations, rewards, terminated, truncated, info = answer
        except (TypeError, ValueError) as error:
            raise wrong_step(answer) from error
        self._ended |= np.stack([self._flags(terminated), self._flags(truncated)])
        over = bool(self._ended.any(axis=0).all())
        terminates, truncates = (self._ended & over).tolist()
        if over:
            self.agents = []
        return (
            self._by_agent("observation", observations),
            self._by_agent("reward", rewards),
            dict(zip(self.possible_agents, terminates, strict=True)),
            dict(zip(self.possible_agents, truncates, strict=True)),
            dict.fromkeys(self.possible_agents, info),
        )

    def _not_ended(self) -> Bools:
        """[2, agents]: no agent has been terminated or truncated in this episode."""
        return np.zeros((2, len(self.possible_agents)), bool)

    def _flags(self, given: Any) -> Bools:
        """The flag of each agent, given one flag for each agent or a single flag for all."""
        flags = np.ravel(given).astype(bool)
        return flags if len(flags) == len(self.possible_agents) else np.full(len(self.possible_agents), flags.all())

    def _by_agent(self, what: str, values: Any) -> dict[str, Any]:
        if not isinstance(values, Sequence | np.ndarray) or len(values) != len(self.possible_agents):
            got = one_line(safe_repr(values), 80)
            raise WrongAnswer(f"{what}: expected one for each of {len(self.possible_agents)} agents, got {got}")
        return dict(zip(self.possible_agents, values, strict=True))

    def render(self) -> Any:
        """The environment's rendered frame."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()
