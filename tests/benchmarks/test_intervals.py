"""The interquartile mean of seeds, and its bootstrap interval."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.intervals import interquartile_means, interval_of


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1, 2, 3, 4, 90], 3),  # one is left out at each end
        ([4, 90, 2, 1, 3], 3),
        ([0, 0, 1, 2, 3, 4, 9, 9], 2.5),  # two
        ([1, 2, 3], 2),  # none
    ],
)
def test_the_lowest_and_the_highest_quarter_are_left_out(values: list[float], expected: float) -> None:
    assert interquartile_means(np.array([values], float)) == [expected]


def test_an_interval_covers_the_mean_as_often_as_it_says() -> None:
    """Of 400 groups of ten normal numbers: a bootstrap of few values covers a little less than 95 %, as is known."""
    generator = np.random.default_rng(1)
    intervals = [interval_of(generator.normal(7, 2, 10).tolist()) for _ in range(400)]
    covered = np.mean([each.low <= 7 <= each.high for each in intervals])
    assert 0.85 < covered < 0.97
    assert all(each.low <= each.mean <= each.high for each in intervals)


def test_it_does_not_depend_on_the_order_of_seeds_and_is_a_point_if_they_agree() -> None:
    assert interval_of([1, 5, 2, 4, 3]) == interval_of([1, 2, 3, 4, 5])
    assert interval_of([500.0] * 6) == (500, 500, 500)
