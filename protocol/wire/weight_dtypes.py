"""Weights as they travel: float32 as they are, or rounded to two bytes each. Pure; imports no torch.

`bfloat16` is the upper half of a float32, sent as uint16: its range, 8 bits of precision. `float16` is IEEE's: 11 bits, and
nothing above 65,504. Both are rounded to the nearest, ties to even. The law: the policy acts under exactly what was sent, so
its log-probabilities are those of the rounded weights; a weight that would become infinite is not sent.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from protocol.arrays import Array, Floats
from protocol.errors import RunError

WeightsDtype = Literal["float32", "bfloat16", "float16"]

# What would be rounded to infinity: halfway between the largest number and what would come next.
BOUNDS = {"bfloat16": (2 - 2**-8) * 2.0**127, "float16": (2 - 2**-11) * 2.0**15}


def to_wire_dtype(parameters: Floats, dtype: WeightsDtype) -> Array:
    """The parameters [P] as they travel; float32 is not copied. Raises `RunError` if one of them does not fit."""
    if dtype == "float32" or parameters.size == 0:
        return parameters
    largest = max(float(parameters.max()), -float(parameters.min()))
    if not largest < BOUNDS[dtype]:  # nor is NaN
        which = int(np.argmax(~(np.abs(parameters) < BOUNDS[dtype])))
        raise RunError(
            f"weights_dtype {dtype}: parameter {which} expected less than {BOUNDS[dtype]:g} either way, got "
            f"{parameters[which]:g}; resume with another weights_dtype, or learn more slowly"
        )
    if dtype == "float16":
        return parameters.astype(np.float16)
    bits = parameters.view(np.uint32)
    rounded = bits >> 16
    rounded &= 1  # a tie goes to the even one: half a unit is added to odd numbers, just less to even ones
    rounded += 0x7FFF
    rounded += bits
    return rounded.view(np.uint16)[1::2].copy()


def to_float32(parameters: Array) -> Floats:
    """The float32 parameters [P] to act under, of those that arrived. Raises ValueError if nobody sends such."""
    match parameters.dtype.str:
        case "<f4":
            return parameters
        case "<f2":
            return parameters.astype(np.float32)
        case "<u2":
            return (parameters.astype(np.uint32) << 16).view(np.float32)
        case other:
            raise ValueError(f"weights expected float32, float16 or bfloat16 as uint16, got {other}")
