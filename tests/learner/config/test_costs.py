"""What costs much time is said before: passes over large observations, evaluations without an end."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.wrappers import TimeLimit

from millrace.learner.config.costs import endless_evaluations, large_observations
from millrace.learner.config.layers import resolve
from millrace.protocol.envs.description import describe_env, read_description
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.specs import PolicySpec
from tests.support.envs.toy import Countdown


def policy_for(shape: tuple[int, ...], dtype: str, net: tuple[int, ...] = (64, 64)) -> PolicySpec:
    space: Box[Any] = Box(0, 255, shape, np.dtype(dtype).type)
    return PolicySpec(observation_leaves(space), action_spec(Discrete(4)), net=net)


def test_what_a_minibatch_of_large_observations_costs_is_said() -> None:
    config = resolve("my_module:Camera", batch_size=64)
    line = large_observations(config, policy_for((240, 320, 3), "uint8"))
    assert line.startswith("an observation of my_module:Camera has 230,400 numbers, so a minibatch of 64 takes 20 billion ")
    assert "gymnasium.wrappers:ResizeObservation(shape=(84, 84))" in line
    line = large_observations(config, policy_for((145_000,), "float32"))
    assert "145,000 numbers, so a minibatch of 64 takes 4 billion multiply-adds" in line
    assert "ResizeObservation" not in line
    assert "a smaller --net" in line


def test_of_usual_observations_nothing_is_said() -> None:
    assert large_observations(resolve("ALE/Pong-v5"), policy_for((84, 84, 4), "uint8", (512,))) == ""
    assert large_observations(resolve("CartPole-v1"), policy_for((4,), "float32")) == ""


def test_an_evaluation_whose_episodes_may_not_end_is_said_before() -> None:
    def line(env: gymnasium.Env[Any, Any], **settings: Any) -> str:
        found = read_description(describe_env(env))
        return endless_evaluations(resolve("my_module:Plant", **settings), found)

    assert line(Countdown(), eval_every=1_000) == (
        "no time limit of my_module:Plant is known: if episodes do not end, an evaluation of 100 episodes takes 1,000,000 "
        'env steps; limit it by --wrappers "gymnasium.wrappers:TimeLimit(max_episode_steps=1000)" or --eval-max-steps'
    )
    assert "an evaluation of 2 episodes takes 500 env steps" in line(Countdown(), eval_episodes=2, eval_max_steps=500)
    assert line(Countdown()) == "", "the evaluation at the end is no longer than training"
    assert line(TimeLimit(Countdown(), 50), eval_every=1_000) == ""
    assert line(gymnasium.make("CartPole-v1"), eval_every=1_000) == ""
