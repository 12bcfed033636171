"""How old weights are when they are used, and how long new ones take."""

from __future__ import annotations

from millrace.learner.rollouts.lag_statistics import MOST_VERSIONS, LagStatistics


def test_lags_are_counted() -> None:
    fresh = LagStatistics()
    fresh.used([2, 0, 0])
    fresh.used([1, 0])
    assert fresh.histogram() == {"0": 3, "1": 1, "2": 1}
    assert list(fresh.histogram()) == ["0", "1", "2"]


def test_only_a_workers_first_rollout_under_new_weights_tells_how_long_they_took() -> None:
    fresh = LagStatistics()
    for version in range(3):
        fresh.published(version, 10.0 * version)
    fresh.arrived("a", 0, 1.0)
    fresh.arrived("a", 0, 5.0)
    fresh.arrived("a", 2, 23.0)  # it never used version 1
    fresh.arrived("a", 1, 29.0)  # late
    fresh.arrived("b", 2, 27.0)
    assert fresh.first_use_s() == {"a": 2.0, "b": 7.0}


def test_versions_of_before_this_learner_and_of_long_ago_tell_nothing() -> None:
    fresh = LagStatistics()
    fresh.arrived("a", 5, 1.0)
    for version in range(6, 10 + MOST_VERSIONS):
        fresh.published(version, float(version))
    fresh.arrived("a", 7, 2_000.0)
    assert fresh.first_use_s() == {}
    assert len(fresh._published_s) == MOST_VERSIONS
