"""Policies of a user's own, each of which has one call that does not return, in the workers alone."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from millrace.protocol.arrays import Array

LEARNER = "PROCESS_THAT_DOES_NOT_HANG"
"""environment variable with a process id: an encoder also computes in the learner"""


class Hangs:
    """Takes the first action, and hangs in this call: `made`, `load` or `act`."""

    def __init__(self, where: str = "act") -> None:
        self._where = where
        self._hang("made")

    def _hang(self, here: str) -> None:
        if here == self._where:
            time.sleep(3600)

    def load(self, arrays: dict[str, Array]) -> None:
        """Needs no weights."""
        self._hang("load")

    def act(self, obs: Array, state: Array, rng: np.random.Generator) -> tuple[Any, Any, dict[str, Any]]:
        """The first action."""
        self._hang("act")
        return np.zeros(len(state), np.int64), state, {}


def encoder(features: int, images: Sequence[tuple[int, ...]]) -> Any:
    """A layer that takes an hour in a worker."""
    from torch import nn  # here, because the policies above have workers without torch

    class HangingEncoder(nn.Linear):
        def forward(self, x: Any) -> Any:
            if os.environ[LEARNER] != str(os.getpid()):
                time.sleep(3600)
            return super().forward(x)

    return HangingEncoder(features, features)
