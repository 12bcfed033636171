"""A saved policy that acts: `millrace.load`. It reads the run folder; it needs no environment, and torch only for images.

Rule: for the same observations, it chooses the same actions as the workers of `millrace evaluate`, bit for bit. This holds
    if you pass as many observations at once as a worker has env copies (`--copies`). In a batch of another size, the last
    bits of a matrix product may differ.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from millrace.arguments import checked
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.action_parts import make_nest
from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.env_actions import action_leaves_of
from millrace.protocol.envs.mask_forms import mask_array, masks_of_copies
from millrace.protocol.errors import UsageError, check_at_least
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.masks import MASK, forbid, masked_distribution, no_choice
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.rows.array_checks import wrong_values
from millrace.protocol.specs import Leaf, PolicySpec

Observation: TypeAlias = Any
"""An observation as an environment or vector environment returns it: an array, a number, or a dict or tuple of these."""


class LoadedPolicy:
    """A policy loaded from a run folder: `policy(observation)` returns an action for `env.step`. `millrace.load` makes it.

    It takes one observation of the environment's space, or n of them stacked along a first axis, and returns one action or n
    actions. An action is an element of the environment's action space: it has the space's dtype and shape, is within the
    space's bounds, and counts from its `start`. For a Dict or Tuple space, it is a dict or tuple. Pass observations as the
    environment returns them; the policy normalizes them if it was trained with normalization.

    A policy with a recurrent core remembers what it saw in each env copy. Call `reset(n)` before you pass the first
    observations, and pass `first` to mark the copies that begin a new episode.

    >>> import gymnasium, millrace
    >>> policy = millrace.load(run)
    >>> isinstance(policy, millrace.LoadedPolicy)
    True
    >>> env = gymnasium.make("CartPole-v1")
    >>> observation, _ = env.reset(seed=1)
    >>> observation, reward, terminated, truncated, _ = env.step(policy(observation))
    """

    def __init__(self, run: Path, *, best: bool, deterministic: bool, seed: int) -> None:
        check_at_least("load: seed", seed, 0)
        self.run: Path = run
        """The run folder."""
        card, parameters, buffers = RunFolder.open_policy(run).read_policy("best" if best else "final")
        self.spec: PolicySpec = card.policy
        """The observations, the actions and the network, as plain data."""
        self.parameters: Floats = parameters
        """The parameters, as a flat float32 vector [P]. Your own learner can start from this policy by passing it to
        `RolloutService.publish`. `PolicyParameters(policy.spec)` names its pieces.
        """
        self.buffers: Floats = buffers
        """Mean and standard deviation of the observations, as a flat float32 vector [2 D] for `RolloutService.publish`;
        empty if the policy doesn't normalize them.
        """
        self._name = f"{card.env}, {'best' if best else 'newest'} policy"
        self._policy = make_policy(card.policy)
        self._policy.load(parameters, buffers)
        self._distribution = distribution(card.policy)
        self._masked_distribution = masked_distribution(card.policy)
        self._is_masked = card.masked
        self._to_env_action = action_leaves_of(card.policy)
        self._nest = make_nest([part.path for part in card.policy.action.parts] or [()])
        self._generator = None if deterministic else generator(seed, Purpose.PLAYED_ACTIONS)
        self._state: Floats | None = None  # [1, n, S]; only if the policy is recurrent, after `reset`

    @checked
    def reset(self, copies: int = 1, *, seed: int | None = None) -> None:
        """Begin new episodes in this number of env copies. Only a policy with a recurrent core needs this call.

        `seed` reseeds the random numbers of a policy that samples its actions. Raises `UsageError` if `copies` is below 1,
        or so large that the recurrent states don't fit into memory.

        >>> import millrace, numpy
        >>> policy = millrace.load(run, deterministic=False)
        >>> policy.reset(2, seed=7)
        >>> actions = policy(numpy.zeros((2, 4)))
        """
        check_at_least("reset: copies", copies, 1)
        check_at_least("reset: seed", seed or 0, 0)
        try:
            self._state = zero_state(self.spec, 1, copies)
        except (MemoryError, ValueError) as error:  # numpy raises ValueError for arrays that are longer than it supports
            raise UsageError(f"reset: copies: expected a number whose states fit into memory, got {copies}") from error
        if seed is not None and self._generator is not None:
            self._generator = generator(seed, Purpose.PLAYED_ACTIONS)

    def __call__(
        self, observation: Observation, *, first: npt.ArrayLike | None = None, mask: npt.ArrayLike | None = None
    ) -> Any:
        """Choose an action for one observation, to pass to `env.step`, or n actions for a batch of n observations.

        A batch of actions is an array [n, *action], or for a Dict or Tuple space a dict or tuple of arrays [n, *part].

        Arguments:
            observation: An element of the environment's observation space, or n of them: arrays [n, *leaf]. A Dict or Tuple
                observation is a dict or tuple of such arrays. The policy normalizes it if it was trained with normalization.
            first: For a recurrent policy: whether this observation is the first of an episode, as a bool or an array [n].
            mask: Which actions are allowed, in the form of `info["action_mask"]`: [choices] bool or int8, or a tuple with an
                array for each entry of the action; or the masks of n observations, such as [n, choices] or the
                `infos["action_mask"]` of a vector environment, with ones for copies that have none because their episodes
                have ended (`~infos["_action_mask"]`). If it is None, a policy that was trained with masks in its
                Dict observations reads them there; otherwise all actions are allowed.

        Raises `UsageError` if the observation isn't in the space, isn't finite, or has a different number of copies than the
        preceding `reset`, or if the mask has a wrong shape or allows no action.

        >>> import millrace
        >>> policy = millrace.load(run)
        >>> int(policy([0.0, 0.0, 0.1, 0.0])) in (0, 1)
        True
        """
        try:
            leaves, is_one = self._leaves(observation)
        except UsageError as error:
            raise UsageError(f"{self!r}: {error}") from None
        n = len(leaves[0][0])
        if mask is None and self._is_masked and isinstance(observation, Mapping):
            mask = observation.get(MASK)
        allowed = None if mask is None else self._checked_mask(mask, n)
        state = self._state_for(n, first)
        with np.errstate(all="ignore"):
            params = self._policy(leaves, state)
            chance = self._distribution
            if allowed is not None:
                params = forbid(params, allowed)
                chance = self._masked_distribution
            if self._generator is None:
                chosen = chance.mode(params)[0]
            else:
                chosen = chance.sample(params, chance.noise(self._generator, (1, n)))[0]
            parts = self._to_env_action(chosen)
        return self._nest([part[0] for part in parts] if is_one else parts)

    def __repr__(self) -> str:
        how = "most probable actions" if self._generator is None else "sampled actions"
        return f"<{self._name} of {self.run}; {how}>"

    def _state_for(self, n: int, first: npt.ArrayLike | None) -> Floats:
        """The recurrent state [1, n, S]; the policy updates it in place. Raises `UsageError` if `reset(n)` wasn't called."""
        if not self.spec.state_size:
            return zero_state(self.spec, 1, n)
        if self._state is None:
            raise UsageError(f"{self!r} is recurrent: call reset({n}) before the first observation of an episode")
        if self._state.shape[1] != n:
            raise UsageError(f"{self!r}: expected {self._state.shape[1]} observations, as in reset, got {n}")
        if first is not None:
            begins = np.asarray(first, bool)
            if begins.shape not in ((), (n,)):
                raise UsageError(f"first: expected a bool, or [{n}] of them, got shape {list(begins.shape)}")
            self._state[0, np.broadcast_to(begins, n)] = 0
        return self._state

    def _checked_mask(self, mask: npt.ArrayLike, n: int) -> Bools:
        """The mask as an array [1, n, choices]. Raises `UsageError` if it has a wrong shape or dtype or allows no action."""
        action = self.spec.action
        size = action.choices
        one = mask_array(mask)
        masks = [one] if _has_bits(one, size) else [mask_array(each) for each in masks_of_copies(mask, n)]
        bits = [each.reshape(-1).astype(bool) for each in masks if each is not None and _has_bits(each, size)]
        if not size or len(bits) < len(masks):
            expected = f"{size} zeros and ones of int8 or bool, or [{n}, {size}]" if size else "none for this action space"
            raise UsageError(f"mask: expected {expected}, got {_forms_of_mask(mask)}")
        allowed: Bools = np.broadcast_to(bits, (1, n, size))
        if (without := no_choice(allowed, action)[0]).any():
            whose = f" for observations {np.flatnonzero(without).tolist()[:20]}" if n > 1 else ""
            raise UsageError(
                f"mask: expected an allowed choice for each entry of the action, got none{whose}; if copies have no mask "
                "because their episodes have ended, pass ones for them"
            )
        return allowed

    def _leaves(self, observation: Observation) -> tuple[tuple[Array, ...], bool]:
        """The arrays [1, n, *leaf] of an observation or a batch of n, and whether it was a single observation."""
        leaves = self.spec.observation
        if len(leaves) == 1 and not leaves[0].path:
            by_path = {"": observation}
        else:
            by_path = dict(_by_path(observation, ""))
            missing = [leaf.path for leaf in leaves if leaf.path not in by_path]
            if missing:
                got = "one array" if "" in by_path else ", ".join(sorted(by_path)) or "nothing"
                raise UsageError(f"observation: expected {missing[0]}, got {got}")
        arrays = [_checked(by_path[leaf.path], leaf) for leaf in leaves]
        numbers = {None if array.shape == leaf.shape else len(array) for array, leaf in zip(arrays, leaves, strict=True)}
        if len(numbers) > 1:
            raise UsageError("observation: expected all its arrays for the same number of env copies, got different ones")
        (number,) = numbers
        n = 1 if number is None else number
        return tuple(array.reshape(1, n, *leaf.shape) for array, leaf in zip(arrays, leaves, strict=True)), number is None


@checked
def load(run: str | os.PathLike[str], *, best: bool = False, deterministic: bool = True, seed: int = 0) -> LoadedPolicy:
    """Load a policy from a run folder, to act with it: `policy(observation)` returns the action.

    Arguments:
        run: The run folder. The run may still be training: its policy is saved with each checkpoint.
        best: Load the policy with the best evaluation during the run (`eval_every`). Otherwise load the newest one, as
            `millrace evaluate` does; if the run has ended, this is the policy of its final evaluation.
        deterministic: Choose the most probable action, as `millrace evaluate` does. Otherwise sample it, as in training.
        seed: Seed of sampled actions.

    It reads policy.safetensors and policy.json; neither the environment nor the algorithm needs to be installed. A policy
    with images or an encoder imports torch. Raises `UsageError`, with a one-line message, if there is no such policy.

    >>> import millrace, numpy
    >>> policy = millrace.load(run)
    >>> one = policy(numpy.zeros(4))
    >>> several = policy(numpy.zeros((8, 4)))
    >>> several.shape
    (8,)
    """
    return LoadedPolicy(Path(run), best=best, deterministic=deterministic, seed=seed)


def _has_bits(mask: Array | None, size: int) -> bool:
    """Whether this is a mask of `size` choices."""
    return mask is not None and mask.size == size and mask.dtype.kind in "biu"


def _forms_of_mask(mask: npt.ArrayLike) -> str:
    """The dtypes and shapes of a mask's parts, for an error."""
    parts = [mask_array(part) for part in (mask if isinstance(mask, tuple | list) else [mask])]
    return one_line(", ".join("no array" if part is None else f"{part.dtype}{list(part.shape)}" for part in parts), 200)


def _by_path(observation: Observation, path: str) -> Iterator[tuple[str, Any]]:
    """The arrays of a Dict or Tuple observation, each with its path (`a/b`), by which the policy knows it."""
    match observation:
        case Mapping():
            parts = list(observation.items())
        case tuple():
            parts = list(enumerate(observation))
        case _:
            yield path, observation
            return
    for name, part in parts:
        yield from _by_path(part, f"{path}/{name}" if path else str(name))


def _checked(value: Any, leaf: Leaf) -> Array:
    """The value as an array [*leaf] or [n, *leaf] of its space's dtype. Raises `UsageError` if it isn't in the space."""
    try:
        given = np.asarray(value)
    except (ValueError, TypeError):  # raised for rows of different lengths, or a tensor on a GPU
        given = np.asarray(None)
    expected = f"{leaf.dtype}{list(leaf.shape)}, or [n, …] of them"
    if leaf.shape not in (given.shape, given.shape[1:]) or not np.can_cast(given.dtype, leaf.dtype, "same_kind"):
        raise UsageError(f"{leaf.name}: expected {expected}, got {given.dtype}{list(given.shape)}")
    with np.errstate(over="ignore"):
        array = given.astype(leaf.dtype, copy=False)
    if why := wrong_values(array, leaf, axes=()):
        raise UsageError(f"{leaf.name}: {why}")
    return array
