"""Converts observations to features, the numbers that a network gets as input. Pure; imports no torch.

The learner and the workers both use this file, so that a network gets the same input everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.specs import Leaf, PolicySpec


def feature_size(spec: PolicySpec) -> int:
    """D, the total number of features of all leaves that are not images."""
    return sum(_feature_count(leaf) for leaf in spec.observation if not leaf.is_image)


def critic_size(spec: PolicySpec) -> int:
    """The number of features that only the critic sees (privileged observations). They are appended to the others."""
    return sum(map(_feature_count, spec.critic))


def _feature_count(leaf: Leaf) -> int:
    return sum(leaf.sizes) if leaf.sizes else math.prod(leaf.shape)


def features(spec: PolicySpec, leaves: Sequence[Array]) -> Array:
    """Features [..., D] of leaves [..., *leaf], not yet normalized. Images are left out.

    Arrays are flattened and divided by `Leaf.divisor`; discrete values become one-hot vectors. The dtype is float32, unless
    the policy normalizes and float32 would lose digits of an array (`Leaf.is_wide`). In that case, it is float64, and
    `normalize` converts the result to float32. The result may be a view of a leaf.
    """
    plain = [(leaf, array) for leaf, array in zip(spec.observation, leaves, strict=True) if not leaf.is_image]
    parts = [_features_of_leaf(leaf, array, spec.normalize_observations) for leaf, array in plain]
    if len(parts) == 1:
        return parts[0]
    if not parts:
        batch_dims = leaves[0].ndim - len(spec.observation[0].shape)
        return np.empty((*leaves[0].shape[:batch_dims], 0), np.float32)
    return np.concatenate(parts, -1)


def _features_of_leaf(leaf: Leaf, array: Array, keep_float64: bool) -> Array:
    batch_shape = array.shape[: array.ndim - len(leaf.shape)]
    if leaf.sizes:
        flat = array.reshape(*batch_shape, len(leaf.sizes))
        if len(leaf.sizes) > 1:
            flat = np.repeat(flat, leaf.sizes, -1)
        return np.equal(flat, _one_hot_values(leaf)).astype(np.float32)
    flat = array.reshape(*batch_shape, math.prod(leaf.shape))
    if leaf.divisor != 1:
        return flat * np.float32(1 / leaf.divisor)
    return flat.astype(np.float64 if keep_float64 and leaf.is_wide else np.float32, copy=False)


@lru_cache(maxsize=64)
def _one_hot_values(leaf: Leaf) -> Array:
    """The discrete value that each one-hot feature of this leaf stands for: [features]."""
    return np.concatenate([np.arange(start, start + n) for start, n in zip(leaf.start, leaf.sizes, strict=True)])


def leaf_of_features(spec: PolicySpec) -> list[Leaf]:
    """For each of the D features, the leaf to which it belongs. Only features of Box leaves are normalized."""
    return [leaf for leaf in spec.observation if not leaf.is_image for _ in range(_feature_count(leaf))]
