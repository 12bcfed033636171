"""The examples' PPO loops solve CartPole-v1."""

from __future__ import annotations

import pytest

from examples.ppo_vector_env import Settings, evaluate, train


@pytest.mark.learning
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_solves_cartpole(seed: int) -> None:
    settings = Settings(seed=seed)
    agent, _ = train(settings, quiet=True)
    assert evaluate(agent, settings) >= 475


@pytest.mark.learning
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_jax_learner_solves_cartpole(seed: int) -> None:
    pytest.importorskip("jax")
    from examples import ppo_jax

    assert ppo_jax.train(ppo_jax.Settings(seed=seed)) >= 475
