"""Weight freshness with a slow worker beside a fast one: the lag stays within its bound, and is measured."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

FLAGS = ["--envs", "4", "--lanes", "4", "--rollout-steps", "8", "--steps", "1200", "--n-epochs", "1", "--eval-episodes", "1"]


@pytest.mark.parametrize("max_lag", [0, 1, 3])
def test_the_lag_is_bounded_whoever_is_slow(tmp_path: Path, max_lag: int) -> None:
    address = f"ipc://{tmp_path}/learner"
    fixed = ["--bind", address, "--run-dir", str(tmp_path / "runs"), "--min-workers", "2", "--max-lag", str(max_lag)]
    command = [sys.executable, "-m", "learner", "workers.envs.toy:Slow-v0", *fixed, *FLAGS, "--env-kwargs", "seconds", "0.0"]
    said = tmp_path / "learner.log"
    with said.open("w") as log:
        learner = subprocess.Popen(command, stderr=log)
    workers = [
        subprocess.Popen(
            [sys.executable, "-m", "workers", address, "--name", name],
            stderr=subprocess.DEVNULL, env={**os.environ, "MILLRACE_TOY_SLEEPS_S": pause_s},
        )
        for name, pause_s in (("fast", "0.0005"), ("slow", "0.005"))
    ]  # fmt: skip
    try:
        assert learner.wait(60) == 0, said.read_text()
        assert [worker.wait(20) for worker in workers] == [0, 0]
    finally:
        for process in (learner, *workers):
            process.kill()
            process.wait()
    (run,) = (tmp_path / "runs").iterdir()
    found: dict[str, Any] = json.loads((run / "summary.json").read_text())
    lags = {int(lag): count for lag, count in found["lags"].items()}
    first_use_ms = {name: round(1_000 * seconds, 1) for name, seconds in found["first_use_s"].items()}
    sys.stdout.write(f"max_lag {max_lag}: rollouts by lag {lags}, ms from publishing to first use {first_use_ms}\n")
    assert max(lags) <= max_lag
    assert sum(lags.values()) == found["ledger"]["used"]
    assert (max(lags) > 0) == (max_lag > 0)
    assert found["first_use_s"]["slow"] > 2 * found["first_use_s"]["fast"] > 0
