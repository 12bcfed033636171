"""Another library on our vector environment: Stable-Baselines3's PPO solves CartPole-v1, with RL Zoo's settings."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from millrace.sb3 import make_vec_env


@pytest.mark.learning
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_stable_baselines3_ppo_solves_cartpole(seed: int) -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy

    env = make_vec_env("CartPole-v1", 8, seed=1000 * seed, workers=2)
    settings = {"n_steps": 32, "batch_size": 256, "n_epochs": 20, "gae_lambda": 0.8, "gamma": 0.98}
    model = PPO(
        "MlpPolicy", env, learning_rate=lambda left: 1e-3 * left, clip_range=lambda left: 0.2 * left, seed=seed,
        device="cpu", **settings,  # type: ignore[arg-type]
    )  # fmt: skip
    model.learn(100_000)
    env.close()
    test = make_vec_env("CartPole-v1", 4, seed=100_000, workers=1)
    mean, _ = evaluate_policy(model, test, n_eval_episodes=20)
    test.close()
    assert np.mean(mean) >= 475
