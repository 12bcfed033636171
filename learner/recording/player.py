"""Plays episodes of a policy on one env copy and keeps them. Deterministic for a seed."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from learner.evaluate import environment_failed
from learner.recording.episodes import RecordedEpisode
from protocol.arrays import Array
from protocol.envs.spaces import make_action_converter, make_flatten
from protocol.policy.distributions import distribution
from protocol.policy.policy import Policy
from protocol.policy.recurrent import zero_state
from protocol.specs import PolicySpec


class Player:
    """Plays one episode after another. Each episode has its own reset seed."""

    def __init__(
        self, env: gymnasium.Env[Any, Any], policy: Policy, spec: PolicySpec, seed: int, stochastic: bool = False
    ) -> None:
        """`stochastic`: draw actions from the policy; otherwise take the most probable ones."""
        self.was_cut = False
        """whether the last episode was stopped because it was too long"""
        self._env, self._policy, self._spec, self._stochastic = env, policy, spec, stochastic
        self._seeds, self._generator = (np.random.default_rng([seed, i]) for i in range(2))
        self._distribution = distribution(spec)
        self._read, self._write = make_flatten(env.observation_space), make_action_converter(spec.action)

    def episode(self, longest: int) -> RecordedEpisode:
        """Play the next episode, of at most `longest` steps. Raises `EnvironmentFailed` if the environment raises."""
        seed = int(self._seeds.integers(2**31))
        rewards: list[float] = []
        ends: list[tuple[bool, bool]] = []  # terminated, truncated
        actions: list[Any] = []
        try:
            observation, _ = self._env.reset(seed=seed)
            self._state = zero_state(self._spec, 1, 1)
            observations = [self._leaves(observation)]
            while not ends or not any(ends[-1]):
                action = self._act(observations[-1])
                observation, reward, terminated, truncated, _ = self._env.step(action)
                self.was_cut = len(actions) + 1 == longest and not (terminated or truncated)
                observations.append(self._leaves(observation))
                actions.append(action)
                rewards.append(float(reward))
                ends.append((bool(terminated), bool(truncated) or self.was_cut))
        except Exception as error:
            raise environment_failed(self._env, error, "it was played") from error
        terminations, truncations = np.array(ends, bool).T
        return RecordedEpisode(
            obs=tuple(np.stack(leaf) for leaf in zip(*observations, strict=True)),
            action=np.stack(actions),
            reward=np.array(rewards),
            terminated=terminations.copy(),
            truncated=truncations.copy(),
            seed=seed,
        )

    def _leaves(self, observation: Any) -> list[Array]:
        """The arrays of an observation, copied: an environment may reuse its own."""
        leaves = zip(self._read(observation), self._spec.observation, strict=True)
        return [np.array(value, leaf.dtype) for value, leaf in leaves]

    def _act(self, leaves: list[Array]) -> Any:
        """The action of the policy, as the environment takes it."""
        params = self._policy([leaf[None, None] for leaf in leaves], self._state)[0]  # [1, P]
        if not self._stochastic:
            return self._write(self._distribution.mode(params))[0]
        return self._write(self._distribution.sample(params, self._distribution.noise(self._generator, (1,))))[0]
