"""What is learned, to published scores, by the command line's own presets: three seeds each (make test-learning).

A run counts by its final policy, or by the one that did best in its own evaluations, tried again on episodes that it was not
chosen by: whichever is better. Nothing is set here but seeds, lags and when to evaluate; see learner/config/presets.toml.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.run_folder import RunFolder

pytestmark = [pytest.mark.learning, pytest.mark.timeout(3600)]

AT_LEAST = [
    ("ppo", "CartPole-v1", 495),
    ("a2c", "CartPole-v1", 475),
    ("impala", "CartPole-v1", 475),
    ("reinforce", "CartPole-v1", 450),
    ("dqn", "CartPole-v1", 475),
    ("ppo", "Pendulum-v1", -200),
    ("a2c", "Pendulum-v1", -300),
    ("ppo", "millrace/CartDoublePendulum-v0", 475),
]
MOST_STEPS = {"CartPole-v1": 300_000, "Pendulum-v1": 500_000, "millrace/CartDoublePendulum-v0": 300_000}
LAGS = {"impala": 2}  # the others learn from the newest weights


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("algo", "env", "at_least"), AT_LEAST)
def test_score(tmp_path: Path, algo: str, env: str, at_least: float, seed: int) -> None:
    config = resolve(env, algo=algo, seed=seed, run_dir=str(tmp_path))
    config = resolve(env, algo=algo, seed=seed, run_dir=str(tmp_path), eval_every=config.steps // 10)
    assert config.steps <= MOST_STEPS[env]
    assert config.max_lag == LAGS.get(algo, 0)
    summary = RunFolder.open(train(config, None, lambda progress: None)).summary()
    assert summary is not None
    assert summary.evaluation is not None
    assert summary.best is not None
    found = [summary.evaluation, summary.best.evaluation]
    assert [each.episodes for each in found] == [100, 100]
    assert max(each.return_mean for each in found) >= at_least


def test_learning_works_while_collecting(tmp_path: Path) -> None:
    """With max_lag 1, on weights one version old."""
    config = resolve("CartPole-v1", seed=1, max_lag=1, run_dir=str(tmp_path))
    summary = RunFolder.open(train(config, None, lambda progress: None)).summary()
    assert summary is not None
    assert summary.evaluation is not None
    assert summary.evaluation.return_mean >= 475
