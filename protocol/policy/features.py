"""From observations to features, the numbers that a network takes as input. Pure; imports no torch.

The learner and the workers both use this file, so that a network gets the same input everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from protocol.arrays import Array, Bools, Floats
from protocol.specs import Leaf, PolicySpec

CLIP = np.float32(10.0)  # normalized observations are clipped to ±10


def feature_size(spec: PolicySpec) -> int:
    """D, the number of features of all leaves that are not images."""
    return sum(_leaf_features(leaf) for leaf in spec.observation if not leaf.is_image)


def _leaf_features(leaf: Leaf) -> int:
    return sum(leaf.sizes) if leaf.sizes else math.prod(leaf.shape)


def features(spec: PolicySpec, leaves: Sequence[Array]) -> Floats:
    """Features [..., D] float32 of leaves [..., *leaf]. Images are left out.

    Arrays are flattened, discrete values become one-hot vectors, and bytes are divided by 255.
    """
    plain = [(leaf, array) for leaf, array in zip(spec.observation, leaves, strict=True) if not leaf.is_image]
    parts = [_features(leaf, array) for leaf, array in plain]
    if len(parts) == 1:
        return parts[0]
    if not parts:
        lead = leaves[0].ndim - len(spec.observation[0].shape)
        return np.empty((*leaves[0].shape[:lead], 0), np.float32)
    return np.concatenate(parts, -1)


def _features(leaf: Leaf, array: Array) -> Floats:
    lead = array.shape[: array.ndim - len(leaf.shape)]
    if leaf.sizes:
        flat = array.reshape(*lead, len(leaf.sizes)) - np.asarray(leaf.start)
        return np.concatenate([np.eye(n, dtype=np.float32)[flat[..., i]] for i, n in enumerate(leaf.sizes)], -1)
    flat = array.reshape(*lead, math.prod(leaf.shape))
    if leaf.dtype == "uint8":
        return flat * np.float32(1 / 255)
    return flat.astype(np.float32, copy=False)


def box_feature_mask(spec: PolicySpec) -> Bools:
    """[D] True for features of a Box. Only these are normalized."""
    plain = [leaf for leaf in spec.observation if not leaf.is_image]
    return np.concatenate([np.full(_leaf_features(leaf), leaf.kind == "box") for leaf in plain] or [np.zeros(0, bool)])


def normalize(x: Floats, mean: Floats, std: Floats) -> Floats:
    """(x − mean) / std, clipped to ±10."""
    return np.asarray(np.clip((x - mean) / std, -CLIP, CLIP))
