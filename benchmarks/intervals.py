"""The mean of several seeds and how sure it is (Agarwal et al. 2021, "Deep RL at the edge of the statistical precipice").

Rule: fewer than five seeds say nothing of their spread, so they are shown one by one, and get no interval. Pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from millrace.protocol.arrays import Doubles

FEWEST = 5
"""seeds of an interval"""
RESAMPLES = 10_000
COVERED = 95
"""percent of the resampled means that lie in the interval"""


class IQM(NamedTuple):
    """An interquartile mean, and the interval in which 95 % of those of resampled seeds lie."""

    mean: float
    low: float
    high: float


def interquartile_means(values: Doubles) -> Doubles:
    """The means [B] of each row [B, N] without its lowest and its highest quarter, ⌊N / 4⌋ values each."""
    cut = values.shape[1] // 4
    kept: Doubles = np.sort(values, axis=1)[:, cut : values.shape[1] - cut]
    return np.asarray(kept.mean(axis=1))


def interval_of(returns: Sequence[float]) -> IQM:
    """The interquartile mean of at least five seeds, with a percentile bootstrap. Equal returns give equal intervals."""
    assert len(returns) >= FEWEST, f"expected at least {FEWEST} seeds, got {len(returns)}"
    values = np.array(sorted(returns))
    drawn = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    outside = (100 - COVERED) / 2
    low, high = np.percentile(interquartile_means(values[drawn]), [outside, 100 - outside])
    return IQM(float(interquartile_means(values[None])[0]), float(low), float(high))
