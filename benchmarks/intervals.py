"""The mean over several seeds and its confidence interval. Pure.

The method is that of Agarwal et al. (2021), "Deep RL at the edge of the statistical precipice".

Rule: fewer than five seeds say nothing about their spread, so they are shown one by one, without an interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from millrace.protocol.arrays import Doubles

FEWEST = 5
"""minimum number of seeds for an interval"""
RESAMPLES = 10_000
COVERED = 95
"""percentage of the resampled means that are in the interval"""


class IQM(NamedTuple):
    """An interquartile mean, and the interval that contains 95 % of the interquartile means of resampled seeds."""

    mean: float
    low: float
    high: float


def interquartile_means(values: Doubles) -> Doubles:
    """The mean of each row of [B, N] without its lowest and its highest ⌊N / 4⌋ values: [B]."""
    cut = values.shape[1] // 4
    kept: Doubles = np.sort(values, axis=1)[:, cut : values.shape[1] - cut]
    return np.asarray(kept.mean(axis=1))


def interval_of(returns: Sequence[float]) -> IQM:
    """The interquartile mean of at least five seeds, with a percentile bootstrap interval. The result is deterministic."""
    assert len(returns) >= FEWEST, f"expected at least {FEWEST} seeds, got {len(returns)}"
    values = np.array(sorted(returns))
    drawn = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    outside = (100 - COVERED) / 2
    low, high = np.percentile(interquartile_means(values[drawn]), [outside, 100 - outside])
    return IQM(float(interquartile_means(values[None])[0]), float(low), float(high))
