"""What each copy of a vector environment gives, out of the batches of `recv` or `step`."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import iterate

from millrace.learner.vector_env.env import ZmqVectorEnv


class Row(NamedTuple):
    """What one copy gives at one step or reset."""

    observation: Any
    reward: Any
    terminated: Any
    truncated: Any
    info: dict[str, Any]


def info_of(infos: dict[str, Any], row: int) -> dict[str, Any]:
    """The info of one copy, out of merged infos. The order of its keys depends on the other copies: they are sorted."""
    return {
        key: info_of(values, row) if isinstance(values, dict) else values[row]
        for key, values in sorted(infos.items())
        if f"_{key}" in infos and infos[f"_{key}"][row]
    }


def received(env: ZmqVectorEnv, min_envs: int = 1) -> dict[int, Row]:
    """What `recv` returns, by copy."""
    observation, reward, terminated, truncated, infos = env.recv(min_envs)
    numbers = reward, terminated, truncated
    ids = infos["env_id"]
    assert ids.dtype == np.int64
    assert ids.tolist() == sorted(set(ids.tolist()))
    each = of_copies(env, observation)
    assert all(len(array) == len(ids) for array in (each, *numbers))
    rows = zip(each, reward, terminated, truncated, (info_of(infos, row) for row in range(len(ids))), strict=True)
    return {int(n): Row(*row) for n, row in zip(ids, rows, strict=True)}


def of_copies(env: VectorEnv[Any, Any, Any], observation: Any) -> list[Any]:
    """The observation of each copy, out of a batch."""
    return [deepcopy(one) for one in iterate(env.observation_space, observation)]
