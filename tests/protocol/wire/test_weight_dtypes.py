"""Weights of two bytes: rounded as torch rounds, to the bit; what would be infinite is not sent."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from millrace.protocol.arrays import Floats
from millrace.protocol.errors import RunError
from millrace.protocol.wire.weight_dtypes import BOUND, ActingDtype, to_float32, to_wire_dtype
from tests.support.examples import examples


def of_bits(bits: Any) -> Floats:
    return np.asarray(bits, np.uint32).view(np.float32)


def as_torch_rounds(parameters: Floats) -> Floats:
    rounded: Floats = torch.from_numpy(parameters.copy()).to(torch.bfloat16).to(torch.float32).numpy()
    return rounded


def same_bits(one: Floats, other: Floats) -> bool:
    return one.dtype == other.dtype == np.float32 and one.tobytes() == other.tobytes()


def fitting(parameters: Floats) -> Floats:
    return parameters[np.abs(parameters) < BOUND]


def test_rounding_is_torchs_to_the_bit() -> None:
    every_upper_half = np.arange(1 << 16, dtype=np.uint32) << 16
    ties = [every_upper_half + low for low in (0, 1, 0x7FFF, 0x8000, 0x8001, 0xFFFF, 0x0FFF, 0x1000, 0x1001, 0x3000)]
    parameters = fitting(of_bits(np.concatenate(ties)))
    assert parameters.size > 100_000
    travelling = to_wire_dtype(parameters, "bfloat16")
    assert travelling.nbytes == parameters.nbytes // 2
    assert same_bits(to_float32(travelling), as_torch_rounds(parameters))


@examples(200)
@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False)))
def test_what_was_rounded_once_is_rounded(values: list[float]) -> None:
    parameters = fitting(np.array(values, np.float32))
    once = to_float32(to_wire_dtype(parameters, "bfloat16"))
    assert same_bits(once, as_torch_rounds(parameters))
    assert same_bits(to_float32(to_wire_dtype(once, "bfloat16")), once)
    assert np.isfinite(once).all()


def test_float32_travels_as_it_lies() -> None:
    parameters = of_bits([0x3F800001, 0x7F800000, 0x7FC00000, 0x80000000])
    assert to_float32(to_wire_dtype(parameters, "float32")) is parameters


def test_what_would_become_infinite_is_refused_and_named() -> None:
    bound = np.float32(BOUND)
    below = np.nextafter(bound, np.float32(0))
    assert np.isinf(as_torch_rounds(np.array([bound]))).all()
    kept = to_float32(to_wire_dtype(np.array([below, -below]), "bfloat16"))
    assert (kept == np.array([1, -1]) * float(torch.finfo(torch.bfloat16).max)).all()
    for wrong in (bound, -bound, np.float32(np.inf), -np.float32(np.inf), np.float32(np.nan)):
        with pytest.raises(
            RunError, match=r"^acting_dtype bfloat16: parameter 2: expected an absolute value below .*, got .*; resume"
        ):
            to_wire_dtype(np.array([0, 1, wrong, 0], np.float32), "bfloat16")


def test_no_parameters_are_no_trouble() -> None:
    for dtype in get_args(ActingDtype):
        assert to_float32(to_wire_dtype(np.zeros(0, np.float32), dtype)).shape == (0,)


@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int8, np.uint32, bool])
def test_weights_of_another_kind_are_not_acted_under(dtype: Any) -> None:
    with pytest.raises(ValueError, match="weights: expected float32, or bfloat16 as uint16"):
        to_float32(np.zeros(3, dtype))
