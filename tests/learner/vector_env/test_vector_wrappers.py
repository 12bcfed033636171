"""gymnasium's own vector wrappers over ours give what they give over `SyncVectorEnv`, to the bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import vector as wrappers

import millrace
from tests.support.bit_equality import alike

Env = VectorEnv[Any, Any, Any]


def shifted(env: Env) -> Env:
    return wrappers.TransformObservation(
        env, lambda obs: obs + np.float32(1), env.observation_space, env.single_observation_space
    )


def informed(env: Env) -> Env:
    return wrappers.DictInfoToList(wrappers.RecordEpisodeStatistics(env))


WRAPPERS: dict[str, tuple[str, Callable[[Env], Env]]] = {
    "RecordEpisodeStatistics": ("CartPole-v1", wrappers.RecordEpisodeStatistics),
    "NormalizeObservation": ("CartPole-v1", wrappers.NormalizeObservation),
    "NormalizeReward": ("CartPole-v1", lambda env: wrappers.NormalizeReward(env, gamma=0.9)),
    "ClipReward": ("CartPole-v1", lambda env: wrappers.ClipReward(env, -0.5, 0.5)),
    "TransformReward": ("CartPole-v1", lambda env: wrappers.TransformReward(env, lambda reward: 2 * reward)),
    "TransformObservation": ("CartPole-v1", shifted),
    "DictInfoToList": ("CartPole-v1", informed),
    "DtypeObservation": ("CartPole-v1", lambda env: wrappers.DtypeObservation(env, np.float64)),
    "FlattenObservation": ("workers.envs.toy:Frames-v0", wrappers.FlattenObservation),
    "ClipAction": ("Pendulum-v1", wrappers.ClipAction),
    "RescaleAction": (
        "Pendulum-v1",
        lambda env: wrappers.RescaleAction(env, np.full(1, -1, np.float32), np.full(1, 1, np.float32)),
    ),
}


@pytest.mark.parametrize("name", WRAPPERS)
def test_a_wrapper_cannot_tell(name: str) -> None:
    env_id, wrap = WRAPPERS[name]
    theirs: Env = SyncVectorEnv([lambda: gymnasium.make(env_id)] * 4, autoreset_mode=AutoresetMode.NEXT_STEP)
    ours = millrace.make_vec(env_id, 4, workers=2)
    try:
        mine, other = wrap(ours), wrap(theirs)
        assert mine.observation_space == other.observation_space
        assert mine.action_space == other.action_space
        assert alike(mine.reset(seed=3), other.reset(seed=3))
        mine.action_space.seed(4)
        ended = 0
        for _ in range(250):
            action = mine.action_space.sample()
            (*row, info), (*their_row, their_info) = mine.step(action), other.step(action)
            assert alike(row, their_row)
            assert alike(_untimed(info), _untimed(their_info))
            ended += int(np.sum(row[2] | row[3]))
        assert ended >= 4
    finally:
        ours.close()
        theirs.close()


def _untimed(info: Any) -> Any:
    """Without the seconds that an episode took."""
    if isinstance(info, list):
        return [_untimed(one) for one in info]
    timeless = {key: value for key, value in info.items() if key not in ("t", "_t")}
    return timeless | ({"episode": _untimed(info["episode"])} if "episode" in info else {})
