"""Greedy episodes of a policy: how good is it? Deterministic for a seed.

Copies are stepped side by side by hand, each for a number of episodes fixed beforehand: waiting for the first so many
episodes to end would favour short ones. Every episode is counted, none is invented.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from learner.run_folder.results import Evaluation
from learner.run_folder.run_folder import RunFolder, Which
from protocol.env_spec import EnvSpec
from protocol.envs.spaces import make_action_converter, make_flatten, observation_leaves
from protocol.errors import EnvironmentFailed, first_line
from protocol.policy.distributions import distribution
from protocol.policy.policy import Policy, make_policy
from protocol.policy.recurrent import zero_state
from protocol.specs import PolicySpec

COPIES = 20
LONGEST_EPISODE = 100_000  # env steps; an environment without a time limit must not stop a run from ending


def evaluate(
    env_spec: EnvSpec,
    policy: Policy,
    spec: PolicySpec,
    episodes: int,
    seed: int,
    pulse: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Act greedily for so many episodes; `pulse` is called at every step. Raises `EnvironmentFailed` if it raises."""
    envs = [env_spec.make() for _ in range(min(episodes, COPIES))]
    try:
        returns, lengths, cut = _play(envs, policy, spec, episodes, seed, pulse)
    finally:
        for env in envs:
            env.close()
    return Evaluation(
        episodes=len(returns),
        return_mean=float(np.mean(returns)),
        return_std=float(np.std(returns)),
        length_mean=float(np.mean(lengths)),
        cut=cut,
    )


class _Copy:
    """One env copy: the episode it is in, and how many more it plays."""

    def __init__(self, env: gymnasium.Env[Any, Any], seed: int, quota: int) -> None:
        self._env = env
        self.left = quota
        self._reset(seed)

    def step(self, action: Any) -> tuple[float, int, bool] | None:
        """One step; return, length and whether it was cut, if that ended an episode."""
        try:
            self.obs, reward, terminated, truncated, _ = self._env.step(action)
        except Exception as error:
            raise _failed(self._env, error) from error
        self._reward += float(reward)
        self._length += 1
        ended = terminated or truncated
        if not ended and self._length < LONGEST_EPISODE:
            return None
        done = self._reward, self._length, not ended
        self.left -= 1
        if self.left:
            self._reset(None)
        return done

    def _reset(self, seed: int | None) -> None:
        self._reward, self._length = 0.0, 0
        try:
            self.obs, _ = self._env.reset(seed=seed)
        except Exception as error:
            raise _failed(self._env, error) from error


def _play(
    envs: list[gymnasium.Env[Any, Any]],
    policy: Policy,
    spec: PolicySpec,
    episodes: int,
    seed: int,
    pulse: Callable[[], None],
) -> tuple[list[float], list[int], int]:
    space = envs[0].observation_space
    read, write, mode = make_flatten(space), make_action_converter(spec.action), distribution(spec).mode
    dtypes = [leaf.dtype for leaf in observation_leaves(space)]
    seeds = np.random.SeedSequence(seed).generate_state(len(envs))
    quotas = [episodes // len(envs) + (i < episodes % len(envs)) for i in range(len(envs))]
    playing = [_Copy(env, int(own), quota) for env, own, quota in zip(envs, seeds, quotas, strict=True)]
    done: list[tuple[float, int, bool]] = []
    state = zero_state(spec, 1, len(playing))
    while playing:
        pulse()
        rows = zip(*(read(copy.obs) for copy in playing), strict=True)
        leaves = [np.asarray(row, dtype)[None] for row, dtype in zip(rows, dtypes, strict=True)]  # [1, N, *leaf]
        actions = write(mode(policy(leaves, state)[0]))  # [N, *action]
        ends = [copy.step(action) for copy, action in zip(playing, actions, strict=True)]
        done += [end for end in ends if end is not None]
        state[0, [end is not None for end in ends]] = 0.0
        state = state[:, [copy.left > 0 for copy in playing]]
        playing = [copy for copy in playing if copy.left]
    returns, lengths, cuts = zip(*done, strict=True)
    return list(returns), list(lengths), sum(cuts)


def load_policy(run: Path, which: Which = "final") -> tuple[Policy, PolicySpec, EnvSpec]:
    """The policy of a run folder, ready to act, and the environment it was made for. Raises `UsageError` in one line."""
    card, parameters, buffers = RunFolder.open(run).read_policy(which)
    policy = make_policy(card.policy)
    policy.load(parameters, buffers)
    return policy, card.policy, EnvSpec(card.env, card.env_kwargs)


def _failed(env: gymnasium.Env[Any, Any], error: Exception) -> EnvironmentFailed:
    """What the environment raised, as ours, with its traceback as text."""
    name = env.spec.id if env.spec else type(env.unwrapped).__name__
    line = f"environment {name} raised while the policy was evaluated: {type(error).__name__}: {first_line(error, '')}"
    return EnvironmentFailed(line, traceback.format_exc())
