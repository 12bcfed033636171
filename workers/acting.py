"""How the actions of a rollout are chosen: by a built-in policy, for all lanes in one pass, or by a user-defined one.

Rule: the actions of a lane depend on its observations, state and random generator, and not on other lanes. Calls to user
code are recorded on the worker's page (`workers/activity.py`), so that the supervisor can enforce their timeouts. Calls to
built-in policies aren't, because recording takes time. In a masked run, the last array of an observation is the mask of the
allowed actions (`millrace.protocol.policy.masks`).
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from millrace.protocol.arrays import Array, Floats
from millrace.protocol.errors import PolicyFailed, first_line
from millrace.protocol.policy.called_policy import Acted, CalledPolicy
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.masks import forbid, masked_distribution
from millrace.protocol.policy.policy import Policy
from millrace.protocol.specs import RunSpec
from millrace.workers.activity import ACTING, activity

Stream = Callable[[], np.random.Generator]
"""Returns a random generator, the same one on each call. Call it only if you need the generator, because seeding takes as
long as a step, and greedy actions need no generator.
"""


class ActedRows(NamedTuple):
    """The arrays of a lane's rollout that its policy has computed."""

    action: Array
    """[T, N, *action]"""
    log_prob: Floats
    """[T, N]"""
    extras: tuple[Array, ...]
    """[T, N, *shape] each"""


class StepActions(Protocol):
    """Chooses the actions of L lanes, step by step."""

    def act(self, t: int, obs: Sequence[Array], state: Floats) -> Array:
        """Choose the actions [L, N, *action] of step t for observations [L, N, *leaf]. Updates `state` [L, N, S] in place.

        The returned array is new, so the caller may change it.
        """
        ...

    def written(self, i: int) -> list[Array]:
        """All arrays [T, N, …] of lane i in which `act` stores its results, with one row for each step."""
        ...


class RolloutActions(StepActions, Protocol):
    """Chooses the actions of one rollout for each of L lanes, and stores them."""

    def chosen(self, i: int) -> Array:
        """The actions [T, N, *action] of lane i, which are among the arrays `written`."""
        ...

    def columns(self, i: int) -> ActedRows:
        """The arrays of lane i, once all T steps are done."""
        ...


class Acting(Protocol):
    """A policy as it acts in rollouts, in evaluations and for opponents."""

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Use these weights from now on."""
        ...

    def begin(self, generators: Sequence[np.random.Generator]) -> RolloutActions:
        """Begin one rollout for each lane. `generators` has the lanes' random generators."""
        ...

    def choose(self, obs: Sequence[Array], state: Floats, stream: Stream, *, greedy: bool) -> Array:
        """Actions [k, *action] for observations [1, k, *leaf]. Updates `state` [1, k, S] in place."""
        ...


def acting_of(run: RunSpec, policy: Policy | CalledPolicy) -> Acting:
    """The `Acting` for this policy in this run."""
    if isinstance(policy, CalledPolicy):
        return _OwnActing(run, policy)
    return _BuiltInActing(run, policy if run.policy.encoder is None else _EncodingPolicy(run.policy.encoder.factory, policy))


class _EncodingPolicy:
    """A built-in policy with a user-defined encoder. Calls to the encoder are recorded on the worker's page, and its errors
    are raised as `PolicyFailed`.
    """

    def __init__(self, encoder: str, policy: Policy) -> None:
        self._encoder = encoder
        self._policy = policy
        self._page = activity()

    def load(self, parameters: Floats, buffers: Floats) -> None:
        self._policy.load(parameters, buffers)

    def __call__(self, leaves: Sequence[Array], state: Floats | None = None) -> Floats:
        try:
            with self._page.during(ACTING):
                return self._policy(leaves, state)
        except Exception as error:
            line = f"encoder {self._encoder}: a pass through it raised {type(error).__name__}: {first_line(error)}"
            raise PolicyFailed(line, traceback.format_exc()) from error


class _BuiltInActing:
    """A built-in policy. One call draws the noise of a whole rollout, and another computes all its log-probabilities."""

    def __init__(self, run: RunSpec, policy: Policy) -> None:
        self.run = run
        self.policy = policy
        self.distribution = masked_distribution(run.policy) if run.masked else distribution(run.policy)

    def load(self, parameters: Floats, buffers: Floats) -> None:
        self.policy.load(parameters, buffers)

    def params(self, obs: Sequence[Array], state: Floats) -> Floats:
        """The distribution params [L, N, P] for observations [L, N, *leaf]. Updates `state` [L, N, S] in place."""
        leaves = obs[: len(self.run.policy.observation)]
        params = self.policy(leaves, state)
        return forbid(params, obs[-1]) if self.run.masked else params

    def begin(self, generators: Sequence[np.random.Generator]) -> RolloutActions:
        return _BuiltInActions(self, generators)

    def choose(self, obs: Sequence[Array], state: Floats, stream: Stream, *, greedy: bool) -> Array:
        params = self.params(obs, state)
        if greedy:
            return self.distribution.mode(params)[0]  # type: ignore[no-any-return]
        noise = self.distribution.noise(stream(), params.shape[:2])
        return self.distribution.sample(params, noise)[0]  # type: ignore[no-any-return]


class _BuiltInActions:
    def __init__(self, acting: _BuiltInActing, generators: Sequence[np.random.Generator]) -> None:
        run = acting.run
        self._distribution = acting.distribution
        self._params_of = acting.params
        L = len(generators)
        T = run.rollout_steps
        N = run.columns
        action = run.policy.action
        self._noise = np.stack([self._distribution.noise(generator, (T, N)) for generator in generators])  # [L, T, N, noise]
        self._params = np.empty((L, T, N, self._distribution.params_size), np.float32)
        self._action = np.empty((L, T, N, *action.shape), action.stored_dtype)

    def act(self, t: int, obs: Sequence[Array], state: Floats) -> Array:
        params = self._params_of(obs, state)
        action = self._distribution.sample(params, self._noise[:, t])
        self._params[:, t] = params
        self._action[:, t] = action
        return action

    def chosen(self, i: int) -> Array:
        return self._action[i]  # type: ignore[no-any-return]

    def columns(self, i: int) -> ActedRows:
        log_prob = self._distribution.log_prob(self._params[i], self._action[i], self._noise[i])  # rule LOG_PROB
        return ActedRows(self._action[i], log_prob, ())

    def written(self, i: int) -> list[Array]:
        return [self._params[i], self._action[i], self._noise[i]]


class _OwnActing:
    """A user-defined policy, called once for each lane."""

    def __init__(self, run: RunSpec, policy: CalledPolicy) -> None:
        self.run = run
        self._policy = policy
        self._page = activity()

    def load(self, parameters: Floats, buffers: Floats) -> None:
        with self._page.during(ACTING):
            self._policy.load(parameters, buffers)

    def act(self, obs: Sequence[Array], state: Floats, generator: np.random.Generator, *, greedy: bool = False) -> Acted:
        """What the policy returns for the copies of one lane, given `obs` [N, *leaf] and `state` [N, S]."""
        mask = obs[-1] if self.run.masked else None
        with self._page.during(ACTING):
            return self._policy.act(obs[: len(self.run.policy.observation)], state, generator, mask=mask, greedy=greedy)

    def begin(self, generators: Sequence[np.random.Generator]) -> RolloutActions:
        return _OwnActions(self, generators)

    def choose(self, obs: Sequence[Array], state: Floats, stream: Stream, *, greedy: bool) -> Array:
        acted = self.act([leaf[0] for leaf in obs], state[0], stream(), greedy=greedy)
        state[0] = acted.state
        return acted.action


class _OwnActions:
    def __init__(self, acting: _OwnActing, generators: Sequence[np.random.Generator]) -> None:
        run = acting.run
        self._acting = acting
        self._generators = generators
        lead = (len(generators), run.rollout_steps, run.columns)
        action = run.policy.action
        self._action = np.empty((*lead, *action.shape), action.stored_dtype)
        self._extras = [np.empty((*lead, *extra.shape), extra.dtype) for extra in run.extras]
        self._log_prob = np.zeros(lead, np.float32)
        self._written = [*self._extras, self._log_prob]  # in the order of `Acted.extras`

    def act(self, t: int, obs: Sequence[Array], state: Floats) -> Array:
        for i, generator in enumerate(self._generators):
            acted = self._acting.act([leaf[i] for leaf in obs], state[i], generator)
            self._action[i, t] = acted.action
            state[i] = acted.state
            for array, extra in zip(self._written, acted.extras, strict=False):  # log_prob, the last, may be absent
                array[i, t] = extra
        return np.array(self._action[:, t])  # a copy, because an environment may change its action

    def chosen(self, i: int) -> Array:
        return self._action[i]  # type: ignore[no-any-return]

    def columns(self, i: int) -> ActedRows:
        return ActedRows(self._action[i], self._log_prob[i], tuple(extra[i] for extra in self._extras))

    def written(self, i: int) -> list[Array]:
        return [self._action[i], *(array[i] for array in self._written)]
