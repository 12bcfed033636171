"""Batches to learn from, made of noise with ends of both kinds, or of an environment that takes seconds to learn."""

from __future__ import annotations

from typing import Literal, Protocol

import msgspec
import numpy as np

from millrace.learner.algorithm_check import toy_batches
from millrace.learner.algorithm_check.toy_batches import ToyActor
from millrace.protocol.action_parts import mixed
from millrace.protocol.arrays import Array
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.numpy_policy import NumpyPolicy
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

BOX = Leaf("", "box", (4,), "float32")
DISCRETE = PolicySpec((BOX,), ActionSpec("discrete", (), "int64", (4,), (0,)), (16,))
GAUSSIAN = PolicySpec((BOX,), ActionSpec("box", (2,), "float32", low=(-1.0,) * 2, high=(1.0,) * 2), (16,))
MIXED = PolicySpec((BOX,), mixed([((0,), GAUSSIAN.action), ((1,), DISCRETE.action)]), (16,))
"""Of a Tuple of both"""
IMAGE = PolicySpec((BOX, Leaf("i", "box", (8, 8, 1), "uint8", divisor=255)), DISCRETE.action, (16,))
LANES, COPIES, T = 2, 3, 20


class Acting(Protocol):
    """What a batch is acted on with."""

    policy: PolicySpec

    def weights(self) -> tuple[Array, Array]: ...


def normal(spec: PolicySpec) -> PolicySpec:
    return msgspec.structs.replace(spec, normalize_observations=True)


def shared(spec: PolicySpec) -> PolicySpec:
    return msgspec.structs.replace(spec, shared_net=True)


def recurrent(spec: PolicySpec, core: Literal["lstm", "gru"]) -> PolicySpec:
    return msgspec.structs.replace(spec, core=core, core_size=8)


def no_pulse() -> None:
    pass


def remembering(algorithm: Acting, obs: Array, valid: Array, state: Array) -> Array:
    """Params [T, N, P] of the algorithm's policy, which begins with `state` [N, S] and forgets by the row format."""
    policy = NumpyPolicy(algorithm.policy)
    policy.load(*algorithm.weights())
    now, found = state[None].copy(), []
    for step, row in zip(obs, valid, strict=True):
        found.append(policy([step[None]], now)[0])
        now[0, ~row] = 0
    return np.stack(found)


def batch(algorithm: Acting, seed: int, fresh: bool = False, steps: int = T) -> Batch:
    """A batch of noise with ends of both kinds, acted on with the algorithm's weights."""
    generator = np.random.default_rng(seed)
    N = LANES * COPIES
    spec = algorithm.policy
    obs: list[Array] = [generator.normal(2, 3, (steps + 1, N, 4)).astype(np.float32)]
    ends, kind = generator.random((steps, N)) < 0.15, generator.random((steps, N)) < 0.5
    valid = np.ones((steps, N), bool)
    for t in range(1, steps):
        valid[t] = ~ends[t - 1]
        ends[t] &= valid[t]
    state = generator.uniform(-0.5, 0.5, (N, spec.state_size)).astype(np.float32)
    over = distribution(spec)
    if spec.needs_torch:
        obs.append(generator.integers(0, 256, (steps + 1, N, 8, 8, 1), dtype=np.uint8))
        params = np.zeros((steps, N, over.params_size), np.float32)
    else:
        params = remembering(algorithm, obs[0][:-1], valid, state)
    noise = over.noise(generator, (steps, N))
    action = over.sample(params, noise)
    return Batch(
        obs=tuple(obs),
        action=action,
        log_prob=over.log_prob(params, action, noise),
        reward=generator.normal(1, 2, (steps, N)).astype(np.float32),
        terminated=ends & kind,
        truncated=ends & ~kind,
        valid=valid,
        state=state,
        lane=np.repeat(np.arange(LANES), COPIES),
        fresh=np.full(N, fresh),
        columns_per_rollout=COPIES,
        episodes=(),
    )


def identity_batch(algorithm: Acting, generator: np.random.Generator) -> tuple[Batch, float]:
    """The identity environment, acted on with the algorithm's weights; and the mean reward."""
    return toy_batches.identity_batch(ToyActor(algorithm.policy, *algorithm.weights()), 32, generator)
