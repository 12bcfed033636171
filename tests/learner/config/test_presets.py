"""Where the settings of a run come from, as a line for the user."""

from __future__ import annotations

from typing import Any

import pytest

from millrace.learner.config.layers import resolve
from millrace.learner.config.presets import origin


@pytest.mark.parametrize(
    ("keywords", "expected"),
    [
        ({}, "settings: preset of ppo for CartPole-v1"),
        ({"gamma": 0.98}, "settings: preset of ppo for CartPole-v1"),
        ({"seed": 5, "workers": 1}, "settings: preset of ppo for CartPole-v1"),
        ({"rollout_steps": 64, "net": (32,)}, "settings: preset of ppo for CartPole-v1, except rollout_steps"),
        ({"env": "millrace/Atari-v0"}, "settings: preset of ppo for millrace/Atari-v0"),
        ({"env": "millrace/Atari-v0", "net": (64,)}, "settings: preset of ppo for millrace/Atari-v0, except net"),
        (
            {"env": "Hopper-v5", "envs": 16},
            "settings: preset of ppo for Hopper-v5, except envs; an update has 4,096 env steps instead of the preset's "
            "2,048; --rollout-steps 128 keeps them",
        ),
        (
            {"env": "Hopper-v5", "envs": 12, "lanes": 4},
            "settings: preset of ppo for Hopper-v5, except envs; an update has 3,072 env steps instead of the preset's "
            "2,048",
        ),
        (
            {"env": "Hopper-v5", "envs": 128},
            "settings: preset of ppo for Hopper-v5, except envs; an update has 32,768 env steps instead of the preset's "
            "2,048",
        ),
        (
            {"env": "Hopper-v5", "envs": 16, "rollout_steps": 128},
            "settings: preset of ppo for Hopper-v5, except envs, rollout_steps",
        ),
        ({"env": "HalfCheetah-v5", "algo": "sac", "envs": 16}, "settings: preset of sac for HalfCheetah-v5, except envs"),
        ({"preset": "none"}, "settings: without the preset of ppo for CartPole-v1"),
        ({"preset": "none", "seed": 2}, "settings: without the preset of ppo for CartPole-v1"),
        (
            {"env": "Taxi-v3", "gamma": 0.9, "steps": 7, "net": (64, 64)},
            "settings: defaults, because ppo has no preset for Taxi-v3; changed: gamma",
        ),
        (
            {"env": "Taxi-v3", "algo": "a2c", "preset": "CartPole-v1"},
            "settings: defaults, because a2c has no preset for Taxi-v3; changed: normalize_rewards",
        ),
        ({"algo": "reinforce", "env": "Acrobot-v1"}, "settings: defaults, because reinforce has no preset for Acrobot-v1"),
    ],
)
def test_the_origin_of_the_settings(keywords: dict[str, Any], expected: str) -> None:
    assert origin(resolve(keywords.pop("env", "CartPole-v1"), **keywords)) == expected
