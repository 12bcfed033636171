"""Evaluates a policy by greedy episodes. Deterministic for a seed.

Several env copies are stepped together. The number of episodes of each is fixed beforehand, because taking the first
episodes that end would favor short ones.
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
LONGEST_EPISODE = 100_000  # env steps; so that a run ends even if the environment has no time limit


def evaluate(
    env_spec: EnvSpec,
    policy: Policy,
    spec: PolicySpec,
    episodes: int,
    seed: int,
    pulse: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Play greedy episodes. `pulse` is called before every step. Raises `EnvironmentFailed` if the environment raises."""
    envs = [env_spec.make() for _ in range(min(episodes, COPIES))]
    try:
        returns, lengths, cut = _play(envs, policy, spec, episodes, seed, pulse)
    finally:
        for env in envs:
            env.close()
    return Evaluation.of(returns, lengths, cut)


class _EnvCopy:
    """One env copy, its current episode, and the number of episodes that it still has to play."""

    def __init__(self, env: gymnasium.Env[Any, Any], seed: int, episodes: int) -> None:
        self._env = env
        self.episodes_left = episodes
        self._reset(seed)

    def step(self, action: Any) -> tuple[float, int, bool] | None:
        """Make one step. If the episode ends: its return, its length, and whether it was stopped because it was too long."""
        try:
            self.obs, reward, terminated, truncated, _ = self._env.step(action)
        except Exception as error:
            raise environment_failed(self._env, error, "the policy was evaluated") from error
        self._reward += float(reward)
        self._length += 1
        ended = terminated or truncated
        if not ended and self._length < LONGEST_EPISODE:
            return None
        done = self._reward, self._length, not ended
        self.episodes_left -= 1
        if self.episodes_left:
            self._reset(None)
        return done

    def _reset(self, seed: int | None) -> None:
        self._reward, self._length = 0.0, 0
        try:
            self.obs, _ = self._env.reset(seed=seed)
        except Exception as error:
            raise environment_failed(self._env, error, "the policy was evaluated") from error


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
    counts = [episodes // len(envs) + (i < episodes % len(envs)) for i in range(len(envs))]
    playing = [_EnvCopy(env, int(own_seed), count) for env, own_seed, count in zip(envs, seeds, counts, strict=True)]
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
        state = state[:, [copy.episodes_left > 0 for copy in playing]]
        playing = [copy for copy in playing if copy.episodes_left]
    returns, lengths, cuts = zip(*done, strict=True)
    return list(returns), list(lengths), sum(cuts)


def load_policy(run: Path, which: Which = "final") -> tuple[Policy, PolicySpec, EnvSpec]:
    """The policy of a run folder, its spec, and the environment for which it was trained.

    Raises `UsageError`, with a one-line message, if the folder or the policy cannot be read.
    """
    card, parameters, buffers = RunFolder.open(run).read_policy(which)
    policy = make_policy(card.policy)
    policy.load(parameters, buffers)
    return policy, card.policy, EnvSpec(card.env, card.env_kwargs)


def environment_failed(env: gymnasium.Env[Any, Any], error: Exception, when: str) -> EnvironmentFailed:
    """Our error for an exception of the environment, with the traceback as text. `when`: as "it was played"."""
    name = env.spec.id if env.spec else type(env.unwrapped).__name__
    line = f"environment {name} raised while {when}: {type(error).__name__}: {first_line(error, '')}"
    return EnvironmentFailed(line, traceback.format_exc())
