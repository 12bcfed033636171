"""Compares two states bit for bit: tensors, arrays, numbers, text, and lists and dicts of these. Pure."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch


def first_difference(left: Any, right: Any, where: str = "") -> str | None:
    """The first place where two states differ, such as `['optimizer']['lr']`; None if they are equal. NaN equals NaN."""
    match left, right:
        case dict(), dict() if left.keys() == right.keys():
            pairs = [(left[key], right[key], f"{where}[{key!r}]") for key in left]
        case (list(), list()) | (tuple(), tuple()) if len(left) == len(right):
            pairs = [(one, other, f"{where}[{i}]") for i, (one, other) in enumerate(zip(left, right, strict=True))]
        case torch.Tensor(), torch.Tensor():
            equal = (
                left.dtype == right.dtype
                and left.shape == right.shape
                and _same(left.detach().cpu().numpy(), right.detach().cpu().numpy())
            )
            return None if equal else where
        case np.ndarray(), np.ndarray():
            equal = left.dtype == right.dtype and left.shape == right.shape and _same(left, right)
            return None if equal else where
        case _:
            return None if type(left) is type(right) and repr(left) == repr(right) else where
    found = (first_difference(*pair) for pair in pairs)
    return next((difference for difference in found if difference is not None), None)


def _same(left: np.ndarray[Any, Any], right: np.ndarray[Any, Any]) -> bool:
    return left.tobytes() == right.tobytes()
