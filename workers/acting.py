"""How the actions of a rollout are chosen: by a policy of ours, for all lanes in one pass, or by the user's own.

Rule: the actions of a lane depend on its observations, state and random generator, and not on the other lanes.
In a masked run, the last array of an observation is the mask of the allowed actions (`protocol.policy.masks`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from protocol.arrays import Array, Bools, Floats
from protocol.policy.called_policy import CalledPolicy
from protocol.policy.distributions import distribution
from protocol.policy.masks import forbid, masked_distribution
from protocol.policy.policy import Policy
from protocol.specs import RunSpec


class ActedRows(NamedTuple):
    """The columns of a rollout that its policy wrote."""

    action: Array
    """[T, N, *action]"""
    log_prob: Floats
    """[T, N]"""
    extras: tuple[Array, ...]
    """[T, N, *shape] each"""


class RolloutActions(Protocol):
    """The actions of one rollout of each of L lanes, step by step."""

    def act(self, t: int, obs: Sequence[Array], state: Floats) -> Array:
        """Choose, and keep, the actions [L, N, *action] of step t in observations [L, N, *leaf]. Updates state [L, N, S]."""
        ...

    def columns(self, i: int) -> ActedRows:
        """After T steps: those of lane i."""
        ...

    def written(self, i: int) -> list[Array]:
        """All arrays [T, N, …] of lane i that `act` writes, one row for each step."""
        ...


class Acting(Protocol):
    """A policy as the collector and the evaluator use it."""

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Use these weights from now on."""
        ...

    def begin(self, generators: Sequence[np.random.Generator]) -> RolloutActions:
        """Begin a rollout of the lanes whose random generators these are."""
        ...

    def choose(self, obs: Sequence[Array], state: Floats, generator: np.random.Generator, *, greedy: bool) -> Array:
        """Actions [k, *action] in observations [1, k, *leaf]. Updates state [1, k, S]."""
        ...


def acting_of(run: RunSpec, policy: Policy | CalledPolicy) -> Acting:
    """How this policy acts in this run."""
    return _OwnActing(run, policy) if isinstance(policy, CalledPolicy) else _BuiltInActing(run, policy)


class _BuiltInActing:
    """A policy of ours. The noise of a whole rollout is drawn in one call, and so are the log-probabilities computed."""

    def __init__(self, run: RunSpec, policy: Policy) -> None:
        self.run, self.policy = run, policy
        self.distribution = masked_distribution(run.policy) if run.masked else distribution(run.policy)

    def load(self, parameters: Floats, buffers: Floats) -> None:
        self.policy.load(parameters, buffers)

    def params(self, obs: Sequence[Array], state: Floats) -> Floats:
        """The distribution parameters [L, N, P]. Updates state."""
        leaves = obs[: len(self.run.policy.observation)]
        params = self.policy(leaves, state)
        return forbid(params, obs[-1]) if self.run.masked else params

    def begin(self, generators: Sequence[np.random.Generator]) -> RolloutActions:
        return _BuiltInActions(self, generators)

    def choose(self, obs: Sequence[Array], state: Floats, generator: np.random.Generator, *, greedy: bool) -> Array:
        params = self.params(obs, state)
        if greedy:
            return self.distribution.mode(params)[0]  # type: ignore[no-any-return]
        noise = self.distribution.noise(generator, params.shape[:2])
        return self.distribution.sample(params, noise)[0]  # type: ignore[no-any-return]


class _BuiltInActions:
    def __init__(self, acting: _BuiltInActing, generators: Sequence[np.random.Generator]) -> None:
        run, self._distribution, self._params_of = acting.run, acting.distribution, acting.params
        L, T, N, action = len(generators), run.rollout_steps, run.columns, run.policy.action
        self._noise = np.stack([self._distribution.noise(generator, (T, N)) for generator in generators])  # [L, T, N, noise]
        self._params = np.empty((L, T, N, self._distribution.params_size), np.float32)
        self._action = np.empty((L, T, N, *action.shape), action.stored_dtype)

    def act(self, t: int, obs: Sequence[Array], state: Floats) -> Array:
        params = self._params_of(obs, state)
        action = self._distribution.sample(params, self._noise[:, t])
        self._params[:, t] = params
        self._action[:, t] = action
        return action

    def columns(self, i: int) -> ActedRows:
        log_prob = self._distribution.log_prob(self._params[i], self._action[i], self._noise[i])
        return ActedRows(self._action[i], log_prob, ())

    def written(self, i: int) -> list[Array]:
        return [self._params[i], self._action[i], self._noise[i]]


class _OwnActing:
    """A policy of the user's, called once for each lane."""

    def __init__(self, run: RunSpec, policy: CalledPolicy) -> None:
        self.run, self.policy = run, policy

    def load(self, parameters: Floats, buffers: Floats) -> None:
        self.policy.load(parameters, buffers)

    def begin(self, generators: Sequence[np.random.Generator]) -> RolloutActions:
        return _OwnActions(self, generators)

    def choose(self, obs: Sequence[Array], state: Floats, generator: np.random.Generator, *, greedy: bool) -> Array:
        leaves, mask = _split([leaf[0] for leaf in obs], self.run)
        acted = self.policy.act(leaves, state[0], generator, mask=mask, greedy=greedy)
        state[0] = acted.state
        return acted.action


class _OwnActions:
    def __init__(self, acting: _OwnActing, generators: Sequence[np.random.Generator]) -> None:
        run, self._policy, self._generators = acting.run, acting.policy, generators
        self._run = run
        lead, action = (len(generators), run.rollout_steps, run.columns), run.policy.action
        self._action = np.empty((*lead, *action.shape), action.stored_dtype)
        self._extras = [np.empty((*lead, *extra.shape), extra.dtype) for extra in run.extras]
        self._log_prob = np.zeros(lead, np.float32)
        self._written = [*self._extras, self._log_prob]  # in the order of `Acted.extras`

    def act(self, t: int, obs: Sequence[Array], state: Floats) -> Array:
        for i, generator in enumerate(self._generators):
            leaves, mask = _split([leaf[i] for leaf in obs], self._run)
            acted = self._policy.act(leaves, state[i], generator, mask=mask)
            self._action[i, t], state[i] = acted.action, acted.state
            for array, extra in zip(self._written, acted.extras, strict=False):  # the last may be absent: log_prob
                array[i, t] = extra
        return np.array(self._action[:, t])  # a copy, because an environment may change its action

    def columns(self, i: int) -> ActedRows:
        return ActedRows(self._action[i], self._log_prob[i], tuple(extra[i] for extra in self._extras))

    def written(self, i: int) -> list[Array]:
        return [self._action[i], *(array[i] for array in self._written)]


def _split(obs: list[Array], run: RunSpec) -> tuple[list[Array], Bools | None]:
    """The arrays of an observation that the actor sees, and its mask."""
    return obs[: len(run.policy.observation)], obs[-1] if run.masked else None
