"""Batches for the check of an algorithm, created in this process: random ones, and batches from the identity environment.

Both follow the row format (`millrace.protocol.rollout`). The random batches contain terminated and truncated episodes. Rows
that are not valid hold rewards that an algorithm must not use. Pure: weights and a generator in, a batch out.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from millrace.protocol.action_parts import mixed
from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

CHOICES = 4
OBSERVATION = (Leaf("", "box", (CHOICES,), "float32"),)
CHOICE = ActionSpec("discrete", (), "int64", (CHOICES,), (0,))
NUMBERS = ActionSpec("box", (2,), "float32", low=(-1.0,) * 2, high=(1.0,) * 2)
ACTIONS = (CHOICE, NUMBERS, mixed([((0,), CHOICE), ((1,), NUMBERS)]))
"""The action spaces to try with an algorithm, in order. The check uses the first one that the algorithm supports."""
LANES = 2
COPIES = 4
GARBAGE_REWARD = 50.0  # the reward of rows that are not valid, which must not be used


class ToyActor(NamedTuple):
    """A policy and its weights."""

    spec: PolicySpec
    parameters: Floats
    buffers: Floats


def noise_batch(acting: ToyActor, steps: int, generator: np.random.Generator, fresh: bool) -> Batch:
    """A batch of random observations and rewards, in which an episode ends on one row in seven.

    `fresh` says whether the lanes begin with this batch.
    """
    columns = LANES * COPIES
    obs = generator.normal(1, 2, (steps + 1, columns, CHOICES)).astype(np.float32)
    ended = generator.random((steps, columns)) < 1 / 7
    valid = np.ones((steps, columns), bool)
    for t in range(1, steps):
        valid[t] = ~ended[t - 1]
        ended[t] &= valid[t]
    terminated = ended & (generator.random((steps, columns)) < 0.5)
    reward = generator.normal(1, 2, (steps, columns)).astype(np.float32)
    return _batch(acting, generator, obs, _OtherColumns(reward, terminated, ended & ~terminated, valid), fresh)


def identity_batch(acting: ToyActor, steps: int, generator: np.random.Generator) -> tuple[Batch, float]:
    """A batch from the identity environment, and its mean reward.

    In this environment, the right action equals the observation. Each episode has one step. The reward for a discrete action
    is 1 if the action is right, otherwise 0. The reward for a Box action is minus its squared distance from the observation.
    For a Dict or Tuple action, the two rewards are added.
    """
    columns = LANES * COPIES
    choice = generator.integers(0, CHOICES, (steps + 1, columns))
    obs = np.eye(CHOICES, dtype=np.float32)[choice]
    valid = np.zeros((steps, columns), bool)
    valid[::2] = True
    none = np.zeros((steps, columns), bool)
    batch = _batch(
        acting, generator, obs, _OtherColumns(np.zeros((steps, columns), np.float32), valid.copy(), none, valid), False
    )
    action = acting.spec.action
    stored = batch.action.reshape(steps, columns, -1)
    reward = np.zeros((steps, columns), np.float32)
    if action.choices:
        reward += stored[..., 0] == choice[:-1]
    if action.numbers:
        reward -= np.square(stored[..., -action.numbers :] - obs[:-1, :, : action.numbers]).sum(-1)
    rewarded = np.where(valid, reward, np.float32(GARBAGE_REWARD))
    return msgspec.structs.replace(batch, reward=rewarded), float(reward[valid].mean())


def with_other_invalid_rows(batch: Batch, generator: np.random.Generator) -> Batch:
    """The same batch with other finite values on rows that are not valid.

    The observations on these rows stay, because they also belong to the previous row, which bootstraps from them. After a
    termination, where nothing bootstraps, the observations are changed too.
    """
    other = generator.permutation(batch.action.reshape(-1, *batch.action.shape[2:])).reshape(batch.action.shape)
    if batch.action.dtype == np.int64:
        other = (batch.action + 1) % CHOICES
    after_termination = np.zeros((len(batch.valid) + 1, batch.valid.shape[1]), bool)
    after_termination[1:-1] = ~batch.valid[1:] & batch.terminated[:-1]
    return msgspec.structs.replace(
        batch,
        obs=tuple(np.where(_for_each(after_termination, leaf), leaf.dtype.type(100), leaf) for leaf in batch.obs),
        action=np.where(_for_each(batch.valid, batch.action), batch.action, other),
        log_prob=np.where(batch.valid, batch.log_prob, np.float32(-7)),
        reward=np.where(batch.valid, batch.reward, np.float32(-1000)),
    )


def with_waiting_seats(batch: Batch) -> Batch:
    """The same rows, as if seats had to wait for one step before the outcome of each action is known.

    Each row becomes two rows. In the first of the two, the seat waits; or, if the row only resets a copy, the copy is reset.
    """
    T, columns = batch.valid.shape
    waits = np.zeros_like(batch.valid)
    valid = np.stack([waits, batch.valid], 1).reshape(2 * T, columns)
    resets = np.concatenate([np.stack([~batch.valid, waits], 1).reshape(2 * T, columns), waits[:1]])
    resets[-1] = batch.terminated[-1] | batch.truncated[-1]

    def twice(array: Array) -> Array:
        return np.repeat(array, 2, axis=0)

    def shown(leaf: Array) -> Array:
        found = np.concatenate([twice(leaf[:-1]), leaf[-1:]])
        found[1::2] = np.where(_for_each(batch.valid, leaf), found[1::2], leaf[1:])
        return found

    return msgspec.structs.replace(
        batch,
        obs=tuple(map(shown, batch.obs)),
        mask=None if batch.mask is None else shown(batch.mask),
        action=twice(batch.action),
        log_prob=twice(batch.log_prob),
        reward=np.where(valid, twice(batch.reward), np.float32(GARBAGE_REWARD)),
        terminated=twice(batch.terminated) & valid,
        truncated=twice(batch.truncated) & valid,
        valid=valid,
        resets=resets,
    )


def _for_each(rows: Bools, array: Array) -> Bools:
    """A mask of rows [T, N], reshaped so that it broadcasts to an array [T, N, …]."""
    return rows.reshape(*rows.shape, *[1] * (array.ndim - 2))


def with_rewards(batch: Batch, reward: float) -> Batch:
    """The same batch with this reward on every valid row."""
    return msgspec.structs.replace(batch, reward=np.where(batch.valid, np.float32(reward), batch.reward))


class _OtherColumns(NamedTuple):
    """The arrays of a batch other than observations and actions, [T, ΣN] each."""

    reward: Floats
    terminated: Bools
    truncated: Bools
    valid: Bools


def _batch(acting: ToyActor, generator: np.random.Generator, obs: Array, rows: _OtherColumns, fresh: bool) -> Batch:
    """A batch in which the policy acts on these observations [T+1, ΣN, CHOICES]."""
    steps, columns = rows.valid.shape
    policy = make_policy(acting.spec)
    over = distribution(acting.spec)
    policy.load(acting.parameters, acting.buffers)
    first = generator.uniform(-0.5, 0.5, (columns, acting.spec.state_size)).astype(np.float32)
    state = first[None].copy()
    params = []
    for observed, valid in zip(obs, rows.valid, strict=False):
        params.append(policy([observed[None]], state)[0])
        state[0, ~valid] = 0
    stacked = np.stack(params)
    noise = over.noise(generator, (steps, columns))
    action = over.sample(stacked, noise)
    return Batch(
        obs=(obs,),
        action=action,
        log_prob=over.log_prob(stacked, action, noise),
        reward=rows.reward,
        terminated=rows.terminated,
        truncated=rows.truncated,
        valid=rows.valid,
        state=first,
        lane=np.repeat(np.arange(LANES), COPIES),
        fresh=np.full(columns, fresh),
        columns_per_rollout=COPIES,
        episodes=(),
    )
