"""The env copies of one lane of a vector environment, in any of the autoreset modes of `workers/env_loop.py`.

Rule: observations, rewards, flags and infos are, bit for bit, those of `gymnasium.vector.SyncVectorEnv` over the same
copies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from protocol.arrays import Array
from protocol.envs.spaces import leaves_with_own_dtype, make_flatten, make_unflatten
from protocol.errors import UsageError
from protocol.specs import Leaf, StepSpec
from workers.env_loop import EnvLoop, Infos, ObservationSink, Pulse


class Rows(NamedTuple):
    """Arrays into which a lane writes the results of its copies: its own, or a part of shared memory."""

    obs: tuple[Array, ...]  # [N, *leaf] each
    reward: Array  # [N] float64
    terminated: Array  # [N] bool
    truncated: Array  # [N] bool


def new_rows(spec: StepSpec, lane: int) -> Rows:
    """New arrays for this lane."""
    N = spec.lanes[lane]
    obs = tuple(np.zeros((N, *leaf.shape), leaf.dtype) for leaf in spec.observation)
    return Rows(obs, np.zeros(N), np.zeros(N, bool), np.zeros(N, bool))


class SteppedLane:
    """N env copies that are stepped together."""

    def __init__(self, spec: StepSpec, lane: int, incarnation: int, rows: Rows, pulse: Pulse) -> None:
        """Make the copies, and reset none. Raises `UsageError` when their spaces are not the vector environment's."""
        self.incarnation = incarnation
        self.rows = rows
        first = spec.first_copy(lane)
        makes = [partial(_make_copy, spec, first + copy, copy) for copy in range(spec.lanes[lane])]
        # Copies of a later incarnation replace lost ones, whose episodes have ended: a step resets them unless `reset` did.
        self._loop = EnvLoop(makes, pulse, spec.autoreset, ended=incarnation > 0)
        env = self._loop.envs[0]
        self._nested_actions = _is_nested(env.action_space)
        self._nest = make_unflatten(env.action_space)
        read = make_flatten(env.observation_space)
        self._fast_sink: ObservationSink = _LeafSink(read, rows.obs) if _is_nested(env.observation_space) else rows.obs[0]
        self._sink: ObservationSink = _CheckedLeafSink(read, rows.obs, spec.observation)

    def reset(self, copies: Sequence[int], seeds: Sequence[int | None], options: Any, pulse: Pulse) -> Infos:
        """Start episodes in these copies, with a seed for each."""
        infos = self._loop.reset(copies, seeds, self._sink, pulse, {"options": options})
        self._copy_flags()
        return infos

    def step(self, actions: Sequence[Array], pulse: Pulse) -> Infos:
        """Step each copy with its row of the actions, which are [N, *leaf] for each leaf."""
        each: Iterable[Any] = map(self._nest, zip(*actions, strict=True)) if self._nested_actions else actions[0]
        infos = self._loop.step(each, self._sink, pulse)
        self._sink = self._fast_sink  # an environment whose first step fits its space, fits later
        self._copy_flags()
        return infos

    def _copy_flags(self) -> None:
        rows, loop = self.rows, self._loop
        rows.reward[:], rows.terminated[:], rows.truncated[:] = loop.reward, loop.terminated, loop.truncated

    def call(self, copies: Sequence[int], name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> list[Any]:
        """The attribute of each of these copies, or its result if it can be called. Its exceptions are not caught."""
        results = []
        for n in copies:
            attribute = self._loop.envs[n].get_wrapper_attr(name)
            results.append(attribute(*args, **kwargs) if callable(attribute) else attribute)
        return results

    def assign(self, copies: Sequence[int], name: str, values: Sequence[Any]) -> None:
        """Set the attribute, to one value for each of these copies."""
        for n, value in zip(copies, values, strict=True):
            self._loop.envs[n].set_wrapper_attr(name, value)

    def close(self) -> None:
        """Close every copy. What a copy raises is ignored."""
        self._loop.close()


def _make_copy(spec: StepSpec, number: int, copy: int) -> gymnasium.Env[Any, Any]:
    """Copy `number` of the vector environment, which is `copy` of its lane. Raises `UsageError` if its spaces are others."""
    env = spec.envs[spec.copies[number]].make(spec.render_mode)
    try:
        fits = (leaves_with_own_dtype(env.observation_space), leaves_with_own_dtype(env.action_space)) == (
            spec.observation,
            spec.action,
        )
    except UsageError:
        fits = False
    if fits:
        return env
    with suppress(Exception):
        env.close()
    raise UsageError(
        f"copy {copy}: its observations {env.observation_space} and actions {env.action_space} are not those of the "
        "vector environment; all copies must have the same, and each machine the same version of the environment"
    )


def _is_nested(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple)


class _LeafSink:
    """Writes the observation of one copy into arrays [N, *leaf], leaf by leaf."""

    def __init__(self, read: Callable[[Any], Sequence[Any]], arrays: Sequence[Array]) -> None:
        self._read, self._arrays = read, arrays

    def __setitem__(self, copy: int, observation: Any) -> None:
        for array, value in zip(self._arrays, self._read(observation), strict=True):
            array[copy] = value


class _CheckedLeafSink(_LeafSink):
    """The same, and raises `ValueError` if an observation does not have the shape and dtype of its space."""

    def __init__(self, read: Callable[[Any], Sequence[Any]], arrays: Sequence[Array], leaves: Sequence[Leaf]) -> None:
        super().__init__(read, arrays)
        self._leaves = leaves

    def __setitem__(self, copy: int, observation: Any) -> None:
        for leaf, stored, value in zip(self._leaves, self._arrays, self._read(observation), strict=True):
            array = np.asarray(value)
            if array.shape != leaf.shape or not np.can_cast(array.dtype, stored.dtype, "same_kind"):
                raise ValueError(
                    f"observation {leaf.path}".strip() + f": expected {leaf.dtype}{list(leaf.shape)} as its space says, "
                    f"got {array.dtype}{list(array.shape)}"
                )
        super().__setitem__(copy, observation)
