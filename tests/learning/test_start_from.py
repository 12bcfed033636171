"""Pendulum trained with gravity 10 learns gravity 12 in at most half the env steps of a start from nothing.

A run is measured by the env steps until the mean return of 20 greedy episodes is at least -300.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import millrace

SETTINGS: dict[str, dict[str, Any]] = {"ppo": {"eval_every": 4000}, "sac": {"eval_every": 500, "net": (64, 64)}}
FIRST_STEPS = {"ppo": 150_000, "sac": 5_000}  # with gravity 10


@pytest.mark.learning
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_it_takes_at_most_half_the_env_steps(tmp_path: Path, algo: str, seed: int) -> None:
    common = SETTINGS[algo] | {"algo": algo, "seed": seed, "run_dir": tmp_path, "eval_episodes": 20, "progress": False}
    earlier = millrace.train("Pendulum-v1", **common | {"steps": FIRST_STEPS[algo], "eval_every": 0})

    def env_steps(**start: Any) -> int:
        summary = millrace.train("Pendulum-v1", env_kwargs={"g": 12.0}, target_return=-300.0, **common, **start).summary
        assert summary is not None
        assert summary.evaluation is not None
        assert summary.evaluation.return_mean >= -300
        return summary.env_steps

    assert env_steps(start_from=earlier) <= env_steps() / 2
