"""The program in examples/ runs unchanged, and its advantages are those of the GAE paper."""

from __future__ import annotations

import pytest
import torch

from examples.ppo_vector_env import Settings, advantages, evaluate, train


def test_advantages_bootstrap_at_truncation_and_not_at_termination() -> None:
    reward, value = torch.ones(3, 2), torch.full((4, 2), 10.0)
    terminated = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    done = torch.tensor([[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]])  # at t = 1 the first copy terminates, the second is truncated
    result = advantages(reward, value, done, terminated, gamma=0.5, lambda_=0.5)
    assert result[2].tolist() == [1 + 5 - 10] * 2
    assert result[1].tolist() == [1 - 10, 1 + 5 - 10]
    assert result[0].tolist() == [-4 + 0.25 * -9, -4 + 0.25 * -4]


@pytest.mark.rest
def test_it_learns_a_little_in_a_short_run() -> None:
    settings = Settings(env_steps=10_240, minibatch=64, epochs=5)
    agent, recent = train(settings, quiet=True)
    assert recent > 30  # random actions give 22
    assert evaluate(agent, settings, episodes=8) > 40
