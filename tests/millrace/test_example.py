"""The example in examples/: it runs as it stands, and its advantages are the textbook's."""

from __future__ import annotations

import torch

from examples.ppo_vector_env import Settings, advantages, greedy, train


def test_advantages_bootstrap_from_the_clocks_end_and_not_from_the_tasks() -> None:
    reward, value = torch.ones(3, 2), torch.full((4, 2), 10.0)
    terminated = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    done = torch.tensor([[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]])  # the first copy dies at t = 1, the second runs out of time
    found = advantages(reward, value, done, terminated, gamma=0.5, lambda_=0.5)
    assert found[2].tolist() == [1 + 5 - 10] * 2
    assert found[1].tolist() == [1 - 10, 1 + 5 - 10]
    assert found[0].tolist() == [-4 + 0.25 * -9, -4 + 0.25 * -4]


def test_it_learns_a_little_in_a_short_run() -> None:
    settings = Settings(env_steps=10_240, minibatch=64, epochs=5)
    agent, recent = train(settings, quiet=True)
    assert recent > 30  # random actions give 22
    assert greedy(agent, settings, episodes=8) > 40
