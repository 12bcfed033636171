"""What is learned, to published scores, by the command line's own defaults: several seeds each (make test-learning)."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from learner.config import resolve
from millrace.launch.local import train

pytestmark = [pytest.mark.learning, pytest.mark.timeout(3600)]


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("env", "at_least", "steps"), [("CartPole-v1", 475, 100_000), ("Pendulum-v1", -250, 300_000)])
def test_ppo(tmp_path: Path, env: str, at_least: float, steps: int, seed: int) -> None:
    """RL Zoo's PPO: 500 after 100k steps and -172; see learner/presets.toml."""
    config = resolve(env, seed=seed, run_dir=str(tmp_path))
    assert config.steps <= steps
    found = json.loads((train(config, None, lambda progress: None) / "summary.json").read_text())
    assert found["evaluation"]["episodes"] == 100
    assert found["evaluation"]["return_mean"] >= at_least


def test_learning_works_while_collecting(tmp_path: Path) -> None:
    """With max_lag 1, on weights one version old."""
    config = resolve("CartPole-v1", seed=1, max_lag=1, run_dir=str(tmp_path))
    found = json.loads((train(config, None, lambda progress: None) / "summary.json").read_text())
    assert found["evaluation"]["return_mean"] >= 475
