"""Recurrent DQN and SAC solve tasks that can't be solved without memory, three seeds each; without memory they do not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.run_folder import RunFolder

pytestmark = [pytest.mark.learning, pytest.mark.timeout(3600)]

RECALL: dict[str, Any] = {
    "env": "tests.support.envs.toy:Recall-v0",
    "algo": "dqn",
    "steps": 20_000,
    "core_size": 16,
    "rollout_steps": 16,
    "batch_size": 256,
    "gradient_steps": 32,
    "learning_starts": 500,
    "learning_rate": 0.003,
    "target_every": 50,
    "epsilon_steps": 5_000,
}
BLIND_PENDULUM: dict[str, Any] = {
    "env": "tests.support.envs.blind_pendulum:BlindPendulum",
    "algo": "sac",
    "steps": 20_000,
    "core_size": 32,
    "net": (64, 64),
    "envs": 4,
    "lanes": 4,
    "rollout_steps": 16,
    "max_lag": 1,
    "batch_size": 512,
    "updates_per_step": 0.25,
    "learning_starts": 1000,
    "learning_rate": 0.001,
}


def greedy_return(tmp_path: Path, core: str | None, seed: int, settings: dict[str, Any]) -> float:
    """The mean of 100 greedy episodes of the best policy of a run."""
    keywords = {**settings, "core": core, "seed": seed, "run_dir": str(tmp_path), "torch_threads": 1}
    config = resolve(keywords.pop("env"), **keywords, eval_every=keywords["steps"] // 10, eval_episodes=100)
    summary = RunFolder.open(train(config, None, lambda progress: None)).summary()
    assert summary is not None
    assert summary.best is not None
    return summary.best.evaluation.return_mean


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_dqn_recalls_what_it_was_shown(tmp_path: Path, seed: int) -> None:
    """One of three signs: whoever does not remember gets 1/3 on average."""
    assert greedy_return(tmp_path, "gru", seed, RECALL) == 1


def test_dqn_without_memory_does_not(tmp_path: Path) -> None:
    assert greedy_return(tmp_path, None, 1, RECALL) < 0.6


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_sac_swings_a_pendulum_whose_velocity_is_hidden(tmp_path: Path, seed: int) -> None:
    """With the velocity, -150 is usual; a pendulum that hangs or spins gets less than -1,000."""
    assert greedy_return(tmp_path, "gru", seed, BLIND_PENDULUM) > -300


def test_sac_without_memory_does_not(tmp_path: Path) -> None:
    assert greedy_return(tmp_path, None, 1, BLIND_PENDULUM) < -800
