"""The face for Stable-Baselines3 gives what its own vector environments give."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.support.bit_equality import bit_equal

sb3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.vec_env import DummyVecEnv  # noqa: E402

from millrace.sb3 import Sb3VecEnv, make_vec_env  # noqa: E402


def dummy(env: str, copies: int, **kwargs: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return DummyVecEnv([lambda: gymnasium.make(env, disable_env_checker=True, **kwargs) for _ in range(copies)])


@pytest.mark.parametrize("env", ["CartPole-v1", "Taxi-v4"])
def test_it_is_the_dummy_vec_env_to_the_bit(env: str) -> None:
    theirs = dummy(env, 3, max_episode_steps=15)
    ours = make_vec_env(env, 3, monitor=False, workers=2, env_kwargs={"max_episode_steps": 15})
    try:
        ours.seed(5), theirs.seed(5)
        assert bit_equal(ours.reset(), theirs.reset())
        draw = np.random.default_rng(2)
        for _ in range(100):
            action = draw.integers(0, theirs.action_space.n, 3)
            (*mine, infos), (*wanted, their_infos) = ours.step(action), theirs.step(action)
            assert bit_equal(mine, wanted)
            for info, other in zip(infos, their_infos, strict=True):
                assert info.keys() == other.keys()
                assert all(np.array_equal(info[key], other[key]) for key in info)
    finally:
        ours.close(), theirs.close()


def test_attributes_and_methods_by_index() -> None:
    env = make_vec_env("workers.envs.toy:Informs-v0", 3, monitor=False, transport="inproc")
    assert isinstance(env, Sb3VecEnv)
    env.set_attr("level", 7, indices=[2, 0])
    assert env.get_attr("level") == [7, 1, 7]
    assert env.get_attr("level", indices=[1, 0]) == [1, 7]
    assert env.env_method("shout", "a", indices=1) == ["A"]
    assert env.has_attr("level")
    assert not env.has_attr("no_such_thing")
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    env.close()


def test_ppo_learns_on_it() -> None:
    env = make_vec_env("CartPole-v1", 4, seed=1, workers=2)
    model = sb3.PPO("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, device="cpu", seed=1)
    model.learn(256)
    assert model.num_timesteps == 256
    assert model.ep_info_buffer[0]["r"] > 0
    env.close()
