"""A loss of one's own (examples/own_loss.py) reaches CartPole's published score, in a run that is resumed on the way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import millrace
from examples.own_loss import ClippedPlus


@pytest.mark.learning
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_loss_of_one_s_own_reaches_475_on_cartpole(tmp_path: Path, seed: int) -> None:
    """With the settings of PPO's preset. The run is short, and then resumed with more steps."""
    settings: dict[str, Any] = {
        "rollout_steps": 32, "batch_size": 256, "n_epochs": 20, "gamma": 0.98, "gae_lambda": 0.8, "learning_rate": 1e-3,
    }  # fmt: skip
    more: dict[str, Any] = {"seed": seed, "run_dir": str(tmp_path), "eval_episodes": 20, "eval_every": 5000}
    run = millrace.train("CartPole-v1", algo=ClippedPlus, steps=4_000, **settings, **more)
    millrace.train(resume=run, steps=150_000, target_return=475.0)
    summary = run.summary
    assert summary is not None
    assert summary.evaluation is not None
    assert summary.evaluation.return_mean >= 475
    assert summary.env_steps > 4_000
