"""Checks the arguments of `reset` and `step`, and converts them to one form. Pure.

The errors have the same types as those that gymnasium's own vector environments raise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.specs import Leaf

SEEDS = range(-(2**63), 2**64)
"""Seeds that a message can carry. If the environment cannot use one of these, it refuses the seed."""


def seed_list(seed: int | Sequence[int | None] | None, num_envs: int) -> list[int | None]:
    """The seed of each env copy. A single seed s gives s, s + 1, ….

    Raises `ValueError` for a wrong number of seeds, and for a seed that no message can carry.
    """
    seeds: list[int | None]
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, int | np.integer):
        seeds = [int(seed) + n for n in range(num_envs)]
    else:
        seeds = [None if one is None else int(one) for one in seed]
    if len(seeds) != num_envs:
        raise ValueError(f"seed: expected one for each of {num_envs} copies, got {len(seeds)}")
    if wrong := [one for one in seeds if one is not None and one not in SEEDS]:
        raise ValueError(f"seed: expected whole numbers of at most 64 bits, got {wrong[0]}")
    return seeds


Options = dict[str, Any] | list[dict[str, Any] | None] | None
"""Options of a reset: the same for all env copies, or a list with the options of each."""


def take_reset_mask(options: Options, num_envs: int) -> tuple[Bools, Options]:
    """The env copies to reset, and the options without the mask. Without a mask all copies are reset.

    Raises `TypeError` for a mask that isn't a bool array. Raises `ValueError` for a mask that has a wrong shape or no True,
    and for a list of options that has a wrong length.
    """
    if isinstance(options, list) and len(options) != num_envs:
        raise ValueError(f"options: expected one for each of {num_envs} copies, got {len(options)}")
    if not isinstance(options, dict) or "reset_mask" not in options:
        return np.ones(num_envs, bool), options
    mask = options["reset_mask"]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise TypeError(f"options['reset_mask']: expected an array of bool, got {getattr(mask, 'dtype', type(mask))}")
    if mask.shape != (num_envs,) or not mask.any():
        raise ValueError(f"options['reset_mask']: expected shape ({num_envs},) and at least one True, got {mask}")
    return mask, {key: value for key, value in options.items() if key != "reset_mask"}


def reset_arguments(
    env_ids: Any, seed: int | Sequence[int | None] | None, options: Options, num_envs: int
) -> tuple[list[int], list[int | None], Options]:
    """The copies to reset, a seed for every copy of the environment, and the options without the mask.

    Raises what `seed_list`, `take_reset_mask` and `numbered` raise, and `ValueError` if there are both `env_ids` and a mask.
    """
    mask, options_without = take_reset_mask(options, num_envs)
    if env_ids is None:
        return np.flatnonzero(mask).tolist(), seed_list(seed, num_envs), options_without
    if options_without is not options:
        raise ValueError("reset: expected env_ids or options['reset_mask'], got both")
    copies = numbered(env_ids, num_envs)
    each = [int(seed) + n for n in copies] if isinstance(seed, int | np.integer) else seed
    by_copy = dict(zip(copies, seed_list(each, len(copies)), strict=True))
    return copies, [by_copy.get(n) for n in range(num_envs)], options


def numbered(env_ids: Any, num_envs: int) -> list[int]:
    """The copies that `env_ids` names, or all if it is None. Raises `TypeError` for anything but whole numbers."""
    if env_ids is None:
        return list(range(num_envs))
    array = np.asarray(env_ids)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise TypeError(f"env_ids: expected a list of whole numbers, got {array.dtype}{list(array.shape)}")
    return [int(n) for n in array]


def action_arrays(
    actions: Any, read: Callable[[Any], tuple[Any, ...]], leaves: Sequence[Leaf], rows: int
) -> tuple[list[Array], bool]:
    """A batch of actions as arrays [rows, *leaf], and whether shared memory can hold them without rounding.

    `read` splits the actions into one value for each of `leaves`. Raises `TypeError` for actions that aren't numbers, and
    `ValueError` for a wrong number of actions.
    """
    arrays = []
    fit = True
    for leaf, value in zip(leaves, read(actions), strict=True):
        array = np.asarray(value)
        if array.ndim == 0 or len(array) != rows:
            raise (ValueError if array.ndim else TypeError)(
                f"actions: expected one for each of {rows} rows, got shape {list(array.shape)}"
            )
        if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
            raise TypeError(f"actions: expected numbers of at most 64 bits, got {array.dtype}")
        if not array.dtype.isnative:
            array = array.astype(array.dtype.newbyteorder("="))
        fit = fit and array.shape[1:] == leaf.shape and (array.dtype == leaf.dtype or np.can_cast(array.dtype, leaf.dtype))
        arrays.append(array)
    return arrays, fit
