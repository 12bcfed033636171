"""Algorithms learn here as in a run: with one thread."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from millrace.learner.algorithms.bodies import networks, stacked_mlps
from millrace.learner.torch_setup import one_thread


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    with one_thread():
        yield


@pytest.fixture
def _float64(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """New networks are of float64, so that only the formulas make a difference."""
    for module in (networks, stacked_mlps):
        monkeypatch.setattr(module, "DTYPE", torch.float64)
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)
