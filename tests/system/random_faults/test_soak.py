"""One minute of the soak: many faults at once, and all requirements afterwards. And its judgements, on made-up figures."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.system.random_faults.soak import Samples, missing_evaluations, soak
from tests.system.stage.network import why_not
from tests.system.stage.processes import Running


@pytest.mark.soak
def test_a_run_survives_a_minute_of_faults(tmp_path: Path) -> None:
    if why := why_not():
        pytest.skip(why)
    assert soak(1.0, seed=1, folder=tmp_path) == []


def rows(*steps: float) -> list[dict[str, Any]]:
    """Rows of metrics after so many env steps. A step count with a half has an evaluation."""
    return [{"time/total_timesteps": int(one)} | ({"eval/mean_reward": 1.0} if one % 1 else {}) for one in steps]


@pytest.mark.parametrize(
    ("found", "short"),
    [
        (rows(40, 80, 120.5, 160, 200.5, 240), []),
        (rows(40, 80, 120, 120.5, 160, 200.5), []),  # the first row of 120 is that of a learner that was killed
        (rows(40, 80, 120, 160, 200.5, 240), ["after 120 env steps: no evaluation"]),
        (rows(40.5, 80, 120.5), ["after 40 env steps: an evaluation was not due"]),
        (rows(250.5, 260.5, 270), []),  # two were due at once
    ],
)
def test_an_evaluation_that_is_missing_or_was_not_due_is_named(found: list[dict[str, Any]], short: list[str]) -> None:
    assert missing_evaluations(found, 100) == short


def test_growth_is_the_slope_of_memory_and_the_change_of_the_median_of_open_files() -> None:
    samples = Samples()
    for second in range(120):
        spike = 50.0 if second == 30 else 0.0
        process = SimpleNamespace(memory_mb=lambda: 100 + second / 20 + spike, descriptors=lambda: 7 if second < 60 else 9)  # noqa: B023
        samples.look(cast(Running, process), float(second))
    slope, minutes, files = samples.growth()
    assert slope == pytest.approx(3.0, abs=0.7)
    assert minutes == pytest.approx(119 / 60)
    assert files == 2
