"""gymnasium's vector wrappers give the same results on our vector environment as on `SyncVectorEnv`, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import vector as wrappers

import millrace
from tests.support.gymnasium_versions import needs_listed_episodes
from tests.support.numbers.bit_equality import bit_equal
from tests.support.variants import variants

Env = VectorEnv[Any, Any, Any]


def shift_observation(env: Env) -> Env:
    return wrappers.TransformObservation(
        env, lambda obs: obs + np.float32(1), env.observation_space, env.single_observation_space
    )


def list_infos(env: Env) -> Env:
    return wrappers.DictInfoToList(wrappers.RecordEpisodeStatistics(env))


WRAPPERS: dict[str, tuple[str, Callable[[Env], Env]]] = {
    "RecordEpisodeStatistics": ("CartPole-v1", wrappers.RecordEpisodeStatistics),
    "NormalizeObservation": ("CartPole-v1", wrappers.NormalizeObservation),
    "NormalizeReward": ("CartPole-v1", lambda env: wrappers.NormalizeReward(env, gamma=0.9)),
    "ClipReward": ("CartPole-v1", lambda env: wrappers.ClipReward(env, -0.5, 0.5)),
    "TransformReward": ("CartPole-v1", lambda env: wrappers.TransformReward(env, lambda reward: 2 * reward)),
    "TransformObservation": ("CartPole-v1", shift_observation),
    "DictInfoToList": ("CartPole-v1", list_infos),
    "DtypeObservation": ("CartPole-v1", lambda env: wrappers.DtypeObservation(env, np.float64)),
    "FlattenObservation": ("tests.support.envs.toy:Frames-v0", wrappers.FlattenObservation),
    "ClipAction": ("Pendulum-v1", wrappers.ClipAction),
    "RescaleAction": (
        "Pendulum-v1",
        lambda env: wrappers.RescaleAction(env, np.full(1, -1, np.float32), np.full(1, 1, np.float32)),
    ),
}


IN_MAKE_TEST = ("RecordEpisodeStatistics", "DictInfoToList", "RescaleAction")  # of episodes, of infos, of actions


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=needs_listed_episodes) if name == "DictInfoToList" else name
        for name in variants(WRAPPERS, default=IN_MAKE_TEST)
    ],
)
def test_a_wrapper_gives_the_same_results(name: str) -> None:
    env_id, wrap = WRAPPERS[name]
    theirs: Env = SyncVectorEnv([lambda: gymnasium.make(env_id)] * 4, autoreset_mode=AutoresetMode.NEXT_STEP)
    ours = millrace.make_vec(env_id, 4, workers=2)
    try:
        mine, other = wrap(ours), wrap(theirs)
        assert mine.observation_space == other.observation_space
        assert mine.action_space == other.action_space
        assert bit_equal(mine.reset(seed=3), other.reset(seed=3))
        mine.action_space.seed(4)
        ended = 0
        for _ in range(250):
            action = mine.action_space.sample()
            (*row, info), (*their_row, their_info) = mine.step(action), other.step(action)
            assert bit_equal(row, their_row)
            assert bit_equal(_without_seconds(info), _without_seconds(their_info))
            ended += int(np.sum(row[2] | row[3]))
        assert ended >= 4
    finally:
        ours.close()
        theirs.close()


def _without_seconds(info: Any) -> Any:
    """The info without the duration of an episode."""
    if isinstance(info, list):
        return [_without_seconds(one) for one in info]
    kept = {key: value for key, value in info.items() if key not in ("t", "_t")}
    return kept | ({"episode": _without_seconds(info["episode"])} if "episode" in info else {})
