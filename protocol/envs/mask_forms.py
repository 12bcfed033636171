"""The forms in which environments and vector environments return masks of allowed actions. Pure.

Rule: a mask is an array, or a list or tuple with an array for each entry of the action. The masks of several env copies are
an array, list or tuple with a mask for each copy. As an exception, a tuple of arrays [N, …] with two or more dimensions
has an array for each entry of the action, as a vector environment returns a Tuple.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from millrace.protocol.arrays import Array


def mask_array(value: Any) -> Array | None:
    """A mask as one array; a list or tuple of masks for several entries is concatenated. None if numpy can't read it."""
    try:
        if isinstance(value, tuple | list) and value and np.ndim(value[0]):
            return np.concatenate([np.asarray(part).reshape(-1) for part in value])
        return np.asarray(value)
    except Exception:  # nested lists of different lengths, or a user-defined object
        return None


def masks_of_copies(given: Any, count: int) -> Sequence[Any]:
    """Split the masks of `count` env copies into one value per copy; `given` itself for each if it isn't their masks."""
    if isinstance(given, tuple) and given and all(getattr(part, "ndim", 0) > 1 and len(part) == count for part in given):
        return list(zip(*given, strict=True))
    if isinstance(given, np.ndarray | list | tuple) and _length(given) == count:
        return list(given)
    return [given] * count


def _length(value: Any) -> int | None:
    """The length of a sequence or an array; None if it has none."""
    try:
        return len(value)
    except TypeError:
        return None
