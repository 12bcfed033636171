"""Bit equality of values, types and dtypes, also of those inside lists, tuples, dicts and arrays."""

from __future__ import annotations

from typing import Any

import numpy as np


def bit_equal(a: Any, b: Any) -> bool:
    """Whether both have the same type and the same bits."""
    if type(a) is not type(b):
        return False
    match a:
        case dict():
            return list(a) == list(b) and all(bit_equal(a[key], b[key]) for key in a)
        case list() | tuple():
            return len(a) == len(b) and all(map(bit_equal, a, b))
        case np.ndarray() if a.dtype.kind == "O":
            return bool(a.shape == b.shape and b.dtype.kind == "O") and all(
                map(bit_equal, a.ravel().tolist(), b.ravel().tolist())
            )
        case np.ndarray() | np.generic():
            return bool(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes())
        case float() | complex():
            return bool(np.array_equal(a, b, equal_nan=True))
        case _:
            return bool(a == b)
