"""The row format. Pure: arrays in, arrays out.

Wherever `valid[t]` is True, row t says: in `obs[t]` the policy took `action[t]`, got `reward[t]` and saw `obs[t+1]`. This is
gymnasium's NEXT_STEP autoreset: the step after an episode's end only resets that copy, so its row has no transition and is
not valid. Hence, for every copy:

    valid[t+1]  ==  not (terminated[t] or truncated[t])

If both flags are set, terminated wins. All code that uses rows (returns, losses, counts, replay buffer) masks with `valid`.

With several agents, a column is one seat of a copy (`millrace.protocol.envs.seats`), and further rows are not valid: those
of a seat that is waiting for others, or isn't present. A valid row of a seat is the one in which the outcome of its action
arrives. Until then, `obs` repeats the observation in which the seat acted, and `action` and `log_prob` repeat its action;
the row after the valid one has the seat's next observation. The sentence above therefore holds for every valid row, and one
rule is added: *a row that is not valid passes through*. Rows between two valid rows of a seat don't change what is carried
from one to the other, such as a return or a recurrent state. Both are still cut where an episode has ended (terminated or
truncated). `resets` says which steps only reset the copy:

    a row that is terminated or truncated is valid, and no later row of that seat is valid until its copy is reset
    a step that resets a copy has no valid row of that copy
    if agents don't take turns, a valid row that is neither terminated nor truncated is followed by a valid one
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.bounds import MAX_COPIES, MAX_FACTS, MAX_SAVED_BYTES, Count, Natural, Real, Seconds, Whole
from millrace.protocol.lane_past import EpisodeBegin
from millrace.protocol.specs import RunSpec

OF_SAVED_BYTES = 1_000  # overhead in bytes for each saved state


class Episode(msgspec.Struct, frozen=True, array_like=True):
    """An episode that ended in this rollout, in raw rewards."""

    reward: Real
    """the return: undiscounted sum of raw rewards (rule EPISODES)"""
    length: Count
    """number of steps (rule EPISODES)"""
    seconds: Seconds
    facts: Annotated[tuple[float, ...], Meta(max_length=MAX_FACTS)] = ()
    """one number for each name in `RunSpec.info_keys`, from the info of the episode's last step; NaN where the info lacked
    it. With `RunSpec.teams`, the score follows; otherwise the return of each seat follows, unless that makes more than 32
    """
    opponent: Whole | None = None
    """who played the other teams, as in a `Permit`; null if the policy played all seats"""


class Rollout(msgspec.Struct, frozen=True, tag=True, array_like=True, forbid_unknown_fields=True):
    """T steps of a lane of N env copies, with actions chosen under one version of the weights."""

    session: Natural
    lane: Natural
    ticket: Natural
    version: Natural
    sequence: Natural
    """counts the rollouts of this lane and incarnation, from 0"""
    obs: tuple[Array, ...]
    """one array [T+1, N, *leaf] for each leaf of the observation"""
    action: Array
    """[T, N, *action] as sampled: int64 counted from 0, or float32, before clipping or in [-1, 1] (`PolicySpec.head`)"""
    log_prob: Array
    """[T, N] float32: log-probabilities under the policy that acted; zeros if it is user-defined and doesn't return them"""
    reward: Array
    """[T, N] float32, raw"""
    terminated: Array
    """[T, N] bool: the task ended; do not bootstrap"""
    truncated: Array
    """[T, N] bool: a time limit ended the episode; bootstrap from obs[t+1]"""
    valid: Array
    """[T, N] bool: False in a row that only resets the copy; with seats, also where no outcome of the seat arrives"""
    state: Array
    """[N, S] float32: state of the recurrent core before obs[0]; S is 0 without a core"""
    episodes: tuple[Episode, ...] = ()
    """the episodes that ended in this rollout, ordered by step, then by copy (rule EPISODE_ORDER)"""
    mask: Array | None = None
    """[T+1, N, choices] bool: which choices were allowed in `obs`; null unless `RunSpec.masked`"""
    extras: tuple[Array, ...] = ()
    """one array [T, N, *shape] for each of `RunSpec.extras`"""
    resets: Array | None = None
    """[T+1, N] bool, with seats: whether step t only resets this copy; the last row belongs to the first step of the next
    rollout. The N of all other arrays is then `RunSpec.sent_columns`. Null without seats, where it would be ~valid"""
    begun: Annotated[tuple[EpisodeBegin, ...], Meta(max_length=MAX_COPIES)] = ()
    """for each copy that has begun an episode since the previous rollout, how its newest one began; empty from a worker that
    cannot report this (rule PAST)"""
    memory: tuple[Array, ...] = ()
    """whatever else the worker needs in order to continue the lane after these rows. The learner returns it unchanged, in
    `LanePast`. Empty from a worker that cannot continue a lane (rule PAST)
    """
    saved: Annotated[tuple[Natural, ...], Meta(max_length=MAX_COPIES)] = ()
    """the copies whose environment has saved its state; the states are in `memory` (rule PAST)"""

    @property
    def env_steps(self) -> int:
        """Number of steps of env copies, not counting those that only reset a copy."""
        return _env_steps(self.valid, self.resets)

    @property
    def steps_that_reset(self) -> Bools:
        """[T+1, N] True where step t only resets the copy; the last row belongs to the first step of the next rollout."""
        if self.resets is not None:
            return self.resets
        return np.concatenate([~self.valid, self.terminated[-1:] | self.truncated[-1:]])


def _env_steps(valid: Array, resets: Array | None) -> int:
    if resets is None:
        return int(np.count_nonzero(valid))
    return int(np.count_nonzero(np.atleast_1d(resets)[:-1] == 0))  # an unchecked rollout may have any shape


def rollout_bytes(run: RunSpec) -> int:
    """Total number of bytes of the arrays in a rollout of this run, not counting the states that environments have saved."""
    T = run.rollout_steps
    N = run.sent_columns
    leaves = [(T + 1, leaf.shape, leaf.dtype) for leaf in run.policy.seen]
    steps = [*leaves, (T, run.policy.action.shape, run.policy.action.stored_dtype), (1, (run.policy.state_size,), "float32")]
    if run.masked:
        steps.append((T + 1, (run.policy.action.choices,), "bool"))
    steps += [(T, extra.shape, extra.dtype) for extra in run.extras]
    fixed = T * N * (2 * np.dtype(np.float32).itemsize + 3)  # log_prob and reward; terminated, truncated and valid
    fixed += (T + 1) * run.copies if run.seats else 0  # resets
    fixed += memory_bytes(run)
    return fixed + sum(rows * N * math.prod(shape) * np.dtype(dtype).itemsize for rows, shape, dtype in steps)


def saved_bytes(copies: int) -> int:
    """Largest number of bytes that the saved states of so many env copies add to `Rollout.memory`."""
    return copies * (MAX_SAVED_BYTES + OF_SAVED_BYTES)


def memory_bytes(run: RunSpec) -> int:
    """Largest number of bytes of `Rollout.memory`, not counting the states that environments have saved.

    Without seats, it is the exact number if the worker can continue a lane.
    """
    if run.teams:
        return 0
    of_copies = run.copies * (run.seats_of_copy + 1) * 8
    of_state = run.columns * run.policy.state_size * 4
    if not run.seats:
        return of_copies + of_state
    action = run.policy.action
    chosen = 32 * (action.choices + math.prod(action.shape) + 1)  # bytes of an action, its distribution params and its noise
    extras = sum(math.prod(extra.shape) * np.dtype(extra.dtype).itemsize for extra in run.extras)
    return of_copies + 2 * of_state + run.columns * (chosen + extras)


class Batch(msgspec.Struct, frozen=True):
    """Several rollouts, concatenated along their columns: T steps of ΣN columns, in lane order."""

    obs: tuple[Array, ...]
    """one array [T+1, ΣN, *leaf] for each leaf"""
    action: Array
    """[T, ΣN, *action]"""
    log_prob: Floats
    reward: Floats
    terminated: Bools
    truncated: Bools
    valid: Bools
    """[T, ΣN] each"""
    state: Floats
    """[ΣN, S] state of the recurrent core before obs[0]"""
    lane: npt.NDArray[np.int64]
    """[ΣN] the lane of each column"""
    fresh: Bools
    """[ΣN] True where the rows don't continue an earlier rollout of the lane, because the lane, or its copy, has just been
    started, or a rollout in between was not used
    """
    columns_per_rollout: int
    """number of columns of each rollout: N, or N · A with seats. The columns of a lane are adjacent, even if the batch has
    several of its rollouts
    """
    episodes: tuple[Episode, ...]
    extras: tuple[Array, ...] = ()
    """one array [T, ΣN, *shape] for each of `RunSpec.extras`"""
    mask: Bools | None = None
    """[T+1, ΣN, choices] which choices were allowed in `obs`; None unless the run uses action masks"""
    resets: Bools | None = None
    """[T+1, copies of all lanes] which steps only reset a copy; None unless the environment has seats"""

    @property
    def env_steps(self) -> int:
        """Number of steps of env copies, not counting those that only reset a copy."""
        return _env_steps(self.valid, self.resets)

    @property
    def columns_per_copy(self) -> int:
        """The number of adjacent columns of an env copy: one for each of its seats, or 1 without seats."""
        return 1 if self.resets is None else self.valid.shape[1] // self.resets.shape[1]

    @property
    def begins(self) -> Bools:
        """[T, ΣN] True where row t only resets its copy, so obs[t+1] begins an episode."""
        return ~self.valid if self.resets is None else np.repeat(self.resets[:-1], self.columns_per_copy, axis=1)


def _by_column(flags: bool | Bools, columns: int) -> Bools:
    """The flag of each column, from a single flag for all, or from flags [N] for N env copies."""
    return np.repeat(np.atleast_1d(flags), columns // np.size(flags))


def stack_rollouts(rollouts: Sequence[Rollout], fresh: Sequence[bool | Bools] | None = None) -> Batch:
    """Copy rollouts into one writable batch [T, ΣN], in lane order; rollouts of one lane stay in the given order.

    `fresh` says which rollouts don't continue an earlier one. It has an entry for each rollout: a single flag, or an array
    [copies] with a flag for each env copy. If it is None, only the first rollout of a lane is fresh.
    """
    if fresh is None:
        fresh = [rollout.sequence == 0 for rollout in rollouts]
    order = sorted(range(len(rollouts)), key=lambda index: rollouts[index].lane)
    ordered = [rollouts[index] for index in order]

    def side_by_side(arrays: Sequence[Array]) -> Array:
        return np.concatenate(arrays, axis=1)

    def side_by_side_if_any(arrays: Sequence[Array | None]) -> Array | None:
        """The joined array; None if the rollouts don't have it. Either all rollouts of a run have it, or none."""
        return None if arrays[0] is None else side_by_side([array for array in arrays if array is not None])

    columns_per_rollout = ordered[0].reward.shape[1]
    return Batch(
        obs=tuple(side_by_side(leaves) for leaves in zip(*(one.obs for one in ordered), strict=True)),
        action=side_by_side([one.action for one in ordered]),
        log_prob=side_by_side([one.log_prob for one in ordered]),
        reward=side_by_side([one.reward for one in ordered]),
        terminated=side_by_side([one.terminated for one in ordered]),
        truncated=side_by_side([one.truncated for one in ordered]),
        valid=side_by_side([one.valid for one in ordered]),
        state=np.concatenate([one.state for one in ordered]),
        lane=np.repeat([one.lane for one in ordered], columns_per_rollout),
        fresh=np.concatenate([_by_column(fresh[index], columns_per_rollout) for index in order]),
        columns_per_rollout=columns_per_rollout,
        episodes=tuple(episode for one in ordered for episode in one.episodes),
        extras=tuple(side_by_side(arrays) for arrays in zip(*(one.extras for one in ordered), strict=True)),
        mask=side_by_side_if_any([one.mask for one in ordered]),
        resets=side_by_side_if_any([one.resets for one in ordered]),
    )
