"""The env copies of one lane of a vector environment, in any of the autoreset modes of `workers/copies/env_loop.py`.

Rule: observations, rewards, flags and infos are, bit for bit, those of `gymnasium.vector.SyncVectorEnv` over the same
copies.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.envs.description import agents_of, describe_env
from millrace.protocol.envs.spaces import leaves_with_own_dtype, make_flatten, make_unflatten
from millrace.protocol.envs.which_copy import EnvCopy
from millrace.protocol.errors import UsageError
from millrace.protocol.space_spec import EnvDescription
from millrace.protocol.specs import StepSpec
from millrace.workers.activity import MAKING, activity
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.env_loop import CopyInfos, EnvLoop, Pulse
from millrace.workers.copies.row_writers import ObservationWriter, read_leaves, write_numbers
from millrace.workers.copy_slots import EnvMaker


class ResultRows(NamedTuple):
    """The arrays into which a lane writes the results of its copies: arrays of its own, or parts of shared memory."""

    obs: tuple[Array, ...]  # [N, *leaf] each; with seats, all arrays here have N · A rows
    reward: Array  # [N] float64
    terminated: Array  # [N] bool
    truncated: Array  # [N] bool


def new_rows(spec: StepSpec, lane: int) -> ResultRows:
    """New arrays for this lane."""
    N = spec.lanes[lane] * spec.seats_of_copy
    obs = tuple(np.zeros((N, *leaf.shape), leaf.dtype) for leaf in spec.leaves)
    return ResultRows(obs, np.zeros(N), np.zeros(N, bool), np.zeros(N, bool))


class SteppedLane:
    """N env copies that are stepped together."""

    def __init__(self, spec: StepSpec, lane: int, incarnation: int, rows: ResultRows, pulse: Pulse) -> None:
        """Make the copies, without resetting them. Raises `UsageError` if their spaces are not the vector environment's."""
        self.incarnation = incarnation
        self.rows = rows
        self.executed = 0
        """number of the last order from shared memory that was executed"""
        first = spec.first_copy(lane)
        self.count = spec.lanes[lane]
        makes = [EnvMaker(spec.envs[of], spec.render_mode) for of in spec.copies[first : first + self.count]]
        # Copies of a later incarnation replace lost ones, whose episodes count as ended, so a step resets the new copies,
        # unless `reset` has done so before.
        which = _first_copy(spec, lane)
        check = partial(_checked, spec)
        self._loop = EnvLoop(makes, pulse, spec.autoreset, ended=incarnation > 0, first=which, dress=check)
        with activity().during(MAKING):  # reading an attribute may run environment code
            observation = self._loop.envs[0].observation_space
            action = self._loop.envs[0].action_space
        self._nested_actions = _is_nested(action)
        self._nest = make_unflatten(action)
        self._nested_observations = _is_nested(observation)
        self._read = make_flatten(observation)
        self._observations: list[Any] = [None] * self.count  # the last observation that each copy returned
        self._seats = spec.seats
        self._writer = ObservationWriter(spec.leaves, len(rows.reward), spec.seats)
        self._joined = self._writer.joined(array[None] for array in rows.obs)

    # rules RESET_SOME, OPTIONS
    def reset(self, copies: Sequence[int], seeds: Sequence[int | None], options: Any, pulse: Pulse) -> CopyInfos:
        """Begin episodes in these copies, with a seed for each. Returns the infos by row.

        `options` is a list with options for each copy, or the same options for all.
        """
        each = options if isinstance(options, list) else [options] * len(copies)
        return self._write_some(copies, self._loop.reset(copies, seeds, self._observations, pulse, each))

    def step(self, actions: Sequence[Array], pulse: Pulse) -> CopyInfos:
        """Step each copy with its row of `actions`, an array [N, *leaf] for each leaf. Returns the infos by row."""
        step = self._loop.steps
        infos = self._loop.step(self._of_each(actions), self._observations, pulse)
        try:
            return self._write(infos)
        except CopyFailed as error:
            raise CopyFailed(error.copy, f"step {step}", error.line) from error

    def _of_each(self, actions: Sequence[Array]) -> Iterable[Any]:  # rule OWN_ROW
        """The action of each copy."""
        return map(self._nest, zip(*actions, strict=True)) if self._nested_actions else actions[0]

    def _write(self, infos: CopyInfos) -> CopyInfos:
        """Write the rows of all copies. Converts the infos that the loop returned to infos by row."""
        leaves = read_leaves(self._read, self._observations) if self._nested_observations else (self._observations,)
        self._writer.write(self._joined, 0, leaves)
        self._write_numbers()
        return infos

    def _write_some(self, copies: Sequence[int], infos: CopyInfos) -> CopyInfos:
        """Write the rows of these copies after they were reset. Returns the infos by row."""
        for n in copies:  # only these: a copy may overwrite its earlier observation
            leaves = read_leaves(self._read, [self._observations[n]])
            self._writer.write_some(self.rows.obs, [n], [{n: value} for (value,) in leaves])
        self._write_numbers()
        return infos

    def _write_numbers(self) -> None:
        rows = self.rows
        loop = self._loop
        of_all = slice(None)
        write_numbers((rows.reward, rows.terminated, rows.truncated), of_all, (loop.reward, loop.terminated, loop.truncated))

    def call(self, copies: Sequence[int], name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> list[Any]:
        """For each of these copies, the attribute with this name, or, if it is callable, the result of calling it.

        Exceptions of the environment are not caught.
        """
        results = []
        for n in copies:
            attribute = self._loop.envs[n].get_wrapper_attr(name)
            results.append(attribute(*args, **kwargs) if callable(attribute) else attribute)
        return results

    def describe(self, copies: Sequence[int]) -> list[EnvDescription]:
        """The description of each of these copies."""
        return [describe_env(self._loop.envs[n]) for n in copies]

    def assign(self, copies: Sequence[int], name: str, values: Sequence[Any]) -> None:
        """Set the attribute with this name on these copies; `values` has a value for each of them."""
        for n, value in zip(copies, values, strict=True):
            self._loop.envs[n].set_wrapper_attr(name, value)

    def close(self) -> None:
        """Close every copy. Exceptions of the copies are ignored."""
        self._loop.close()


def _first_copy(spec: StepSpec, lane: int) -> EnvCopy:
    """The identity of a lane's first copy."""
    number = spec.first_copy(lane)
    position = number - (len(spec.copies) - spec.evaluation_copies)
    return EnvCopy(number, lane) if position < 0 else EnvCopy(position, copy=position, evaluation=True)


def _checked(spec: StepSpec, env: gymnasium.Env[Any, Any], which: EnvCopy) -> gymnasium.Env[Any, Any]:
    """Return the copy `env`. Raises `UsageError` if its spaces or agents differ from those of the vector environment."""
    copy = f"{'evaluation ' if which.evaluation else ''}copy {which.number}"
    try:
        fits = (leaves_with_own_dtype(env.observation_space), leaves_with_own_dtype(env.action_space)) == (
            spec.observation,
            spec.action,
        )
    except UsageError:
        fits = False
    if fits and (agents := agents_of(env)[0]) == spec.seats:
        return env
    if fits:
        raise UsageError(f"{copy}: expected agents {list(spec.seats)} as copy 0 has, got {list(agents)}")
    raise UsageError(
        f"{copy}: its observations {env.observation_space} and actions {env.action_space} are not those of the "
        "vector environment; all copies must have the same, and each machine the same version of the environment"
    )


def _is_nested(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple)
