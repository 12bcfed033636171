"""Dtypes in which weights are sent: float32, or rounded to two bytes each. Pure; imports no torch.

`bfloat16` is the upper half of a float32, sent as uint16: the range of float32, 8 bits of precision. `float16` is IEEE half
precision: 11 bits, at most 65,504. Both round to nearest, ties to even. Rule: the policy acts with exactly the weights
that were sent, so its log-probabilities are those of the rounded weights. A weight that would become infinite is not sent.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from protocol.arrays import Array, Floats
from protocol.errors import RunError

WeightsDtype = Literal["float32", "bfloat16", "float16"]

# From here on values round to infinity: halfway between the largest number and the next power of two.
BOUNDS = {"bfloat16": (2 - 2**-8) * 2.0**127, "float16": (2 - 2**-11) * 2.0**15}


def to_wire_dtype(parameters: Floats, dtype: WeightsDtype) -> Array:
    """Convert float32 parameters [P] to `dtype`; float32 is not copied. Raises `RunError` if one is out of range."""
    if dtype == "float32" or parameters.size == 0:
        return parameters
    largest = max(float(parameters.max()), -float(parameters.min()))
    if not largest < BOUNDS[dtype]:  # also true for NaN
        which = int(np.argmax(~(np.abs(parameters) < BOUNDS[dtype])))
        raise RunError(
            f"weights_dtype {dtype}: parameter {which}: expected an absolute value below {BOUNDS[dtype]:g}, got "
            f"{parameters[which]:g}; resume with another weights_dtype, or with a smaller learning rate"
        )
    if dtype == "float16":
        return parameters.astype(np.float16)
    bits = parameters.view(np.uint32)
    rounded = bits >> 16
    rounded &= 1  # round half to even: odd numbers get half a unit, even ones slightly less
    rounded += 0x7FFF
    rounded += bits
    return rounded.view(np.uint16)[1::2].copy()


def to_float32(parameters: Array) -> Floats:
    """Received parameters [P] as float32. Raises `ValueError` for a dtype that is never sent."""
    match parameters.dtype.str:
        case "<f4":
            return parameters
        case "<f2":
            return parameters.astype(np.float32)
        case "<u2":
            return (parameters.astype(np.uint32) << 16).view(np.float32)
        case other:
            raise ValueError(f"weights: expected float32, float16 or bfloat16 as uint16, got {other}")
