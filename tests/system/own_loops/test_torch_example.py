"""examples/ppo_torch.py: PPO over `RolloutService` learns the same weights as the built-in PPO, bit for bit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

import millrace
from examples.ppo_torch import Settings, train
from millrace.learner.run_folder.run_folder import RunFolder

NOT_SETTINGS_OF_TRAINING = {"env"}


@pytest.mark.parametrize(
    ("updates", "epochs"), [(3, 2), pytest.param(20, 10, marks=pytest.mark.soak)], ids=["few updates", "twenty updates"]
)
def test_the_weights_are_those_of_the_built_in_ppo(tmp_path: Path, updates: int, epochs: int) -> None:
    settings = Settings(steps=updates * 8 * 64, n_epochs=epochs)
    same = {name: value for name, value in dataclasses.asdict(settings).items() if name not in NOT_SETTINGS_OF_TRAINING}
    same |= {"normalize_observations": False, "normalize_rewards": False}
    run = millrace.train(
        settings.env, algo="ppo", preset="none", torch_threads=1, eval_episodes=1, run_dir=str(tmp_path), **same
    )
    summary = RunFolder.open(Path(run)).summary()
    assert summary is not None
    assert summary.updates == updates
    built_in = load_file(Path(run) / "policy.safetensors")
    ours = train(settings)
    names = [f"actor.{layer}.{kind}" for layer in ("0", "1", "out") for kind in ("weight", "bias")]
    assert np.array_equal(np.concatenate([built_in[name].ravel() for name in names]), ours)
