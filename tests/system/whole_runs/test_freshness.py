"""The age of weights with a slow and a fast worker: the lag is measured and stays within its bound."""

from __future__ import annotations

import sys

import pytest

from tests.system.stage.processes import TOY, Stage


@pytest.mark.parametrize("max_lag", [0, 1, pytest.param(3, marks=pytest.mark.soak)])
def test_the_lag_is_bounded_with_a_slow_worker(stage: Stage, monkeypatch: pytest.MonkeyPatch, max_lag: int) -> None:
    address = f"ipc://{stage.tmp_path}/learner"
    settings = {"envs": 4, "lanes": 4, "rollout-steps": 8, "batch-size": 32, "steps": 600, "env-kwargs": "seconds 0.0"}
    learner = stage.learner(address, {**settings, "min-workers": 2, "max-lag": max_lag}, env=TOY)
    workers = []
    for name, pause_s in (("fast", "0.0005"), ("slow", "0.005")):
        monkeypatch.setenv("MILLRACE_TOY_SLEEPS_S", pause_s)
        workers.append(stage.worker(address, name))
    assert learner.ends(60) == 0, learner.said()
    assert [worker.ends() for worker in workers] == [0, 0]
    found = learner.summary()
    lags = {int(lag): count for lag, count in found["lags"].items()}
    first_use_ms = {name: round(1_000 * seconds, 1) for name, seconds in found["first_use_s"].items()}
    sys.stdout.write(f"max_lag {max_lag}: rollouts by lag {lags}, ms from publishing to first use {first_use_ms}\n")
    assert max(lags) <= max_lag
    assert sum(lags.values()) == found["ledger"]["used"]
    assert (max(lags) > 0) == (max_lag > 0)
    assert found["first_use_s"]["slow"] > 2 * found["first_use_s"]["fast"] > 0
