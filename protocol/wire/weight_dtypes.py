"""The dtypes in which weights are sent: float32, or rounded to bfloat16, which has two bytes. Pure; imports no torch.

A bfloat16 is the upper half of a float32, sent as uint16: it has the range of float32, and 8 bits of precision. Weights are
rounded to the nearest, ties to even. Rule: the policy acts with exactly the weights that were sent, so its log-probabilities
are those of the rounded weights. A weight that would become infinite is not sent.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from millrace.protocol.arrays import Array, Floats
from millrace.protocol.errors import RunError

ActingDtype = Literal["float32", "bfloat16"]

# Values from here on are rounded to infinity: this is halfway between the largest bfloat16 and the next power of two.
BOUND = (2 - 2**-8) * 2.0**127


def to_wire_dtype(parameters: Floats, dtype: ActingDtype) -> Array:
    """Convert float32 parameters [P] to `dtype`; if that is float32 too, they aren't copied.

    Raises `RunError` if a parameter is out of range.
    """
    if dtype == "float32" or parameters.size == 0:
        return parameters
    largest = max(float(parameters.max()), -float(parameters.min()))
    if not largest < BOUND:  # also true for NaN
        which = int(np.argmax(~(np.abs(parameters) < BOUND)))
        raise RunError(
            f"acting_dtype {dtype}: parameter {which}: expected an absolute value below {BOUND:g}, got "
            f"{parameters[which]:g}; resume with acting_dtype float32, or with a smaller learning rate"
        )
    bits = parameters.view(np.uint32)
    rounded = bits >> 16
    rounded &= 1  # round half to even: odd numbers get half a unit, even ones slightly less
    rounded += 0x7FFF
    rounded += bits
    return rounded.view(np.uint16)[1::2].copy()


def to_float32(parameters: Array) -> Floats:  # rule ROUNDED
    """Received parameters [P] as float32. Raises `ValueError` for a dtype that is never sent."""
    match parameters.dtype.str:
        case "<f4":
            return parameters
        case "<u2":
            return (parameters.astype(np.uint32) << 16).view(np.float32)
        case other:
            raise ValueError(f"weights: expected float32, or bfloat16 as uint16, got {other}")
