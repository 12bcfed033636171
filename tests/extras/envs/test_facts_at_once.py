"""Facts of episodes whose copies are stepped at once: by envpool, and by an environment's own vectorized form."""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest

from millrace.extras.envs.envpool_copies import EnvpoolCopies
from millrace.protocol.rollout import Rollout
from millrace.protocol.rows.rollout_checks import validate
from tests.support.in_process.collectors import collect, no_pulse, random_collector, run_of


def facts(rollout: Rollout) -> list[tuple[float, ...]]:
    return [episode.facts for episode in rollout.episodes]


class Pool:
    """Stands for an envpool of two copies: copy n ends by itself after 3 + n steps, and reports its steps."""

    def __init__(self) -> None:
        self.t = np.zeros(2, int)

    def reset(self, copies: Any = slice(None)) -> Any:
        self.t[copies] = 0
        return np.zeros((len(self.t[copies]), 1), np.float32), {}

    def step(self, actions: Any, copies: Any = None) -> Any:
        own = np.arange(2) if copies is None else np.asarray(copies)
        over = self.t[own] >= 3 + own  # envpool resets these in this step
        self.t[own] = np.where(over, 0, self.t[own] + 1)
        ended = self.t[own] >= 3 + own
        infos = {"elapsed_step": self.t[own].copy(), "copy": own * 10.0}
        return np.zeros((len(own), 1), np.float32), np.ones(len(own)), ended, np.zeros(len(own), bool), infos

    def close(self) -> None:
        pass


class PoolSpec:
    """Stands for `EnvpoolSpec`, with a time limit of 3 steps."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    action_space = gymnasium.spaces.Discrete(2)
    limit = 3

    def make(self, seeds: Any) -> Pool:
        return Pool()


def test_envpool_at_its_time_limit() -> None:
    """Copy 0 terminates at the limit; copy 1 is truncated here, so that copy 0 is stepped while copy 1 is reset."""
    copies = EnvpoolCopies(PoolSpec(), 2, ("elapsed_step", "copy"))  # type: ignore[arg-type]
    copies.reset([1, 2], no_pulse)
    found = [dict(copies.step(np.zeros(2, int), no_pulse).facts) for _ in range(8)]
    assert found == [{}, {}, {0: (3.0, 0.0), 1: (3.0, 10.0)}, {}, {}, {}, {0: (3.0, 0.0), 1: (3.0, 10.0)}, {}]


@pytest.mark.skipif(find_spec("envpool") is None, reason="envpool is not here: pip install envpool")
def test_envpool() -> None:
    """Also at the time limit, which is applied here, and in steps in which some copies are reset explicitly."""
    run = msgspec.structs.replace(
        run_of("CartPole-v1", T=200, N=8, kwargs={"max_episode_steps": 20}),
        vector="envpool",
        info_keys=("elapsed_step", "no"),
    )
    (rollout,) = collect(random_collector(run), run)
    validate(rollout, run)
    lengths = [episode.length for episode in rollout.episodes]
    assert 20 in lengths
    assert min(lengths) < 20
    assert [row[0] for row in facts(rollout)] == lengths
    assert all(math.isnan(row[1]) for row in facts(rollout))


def test_a_native_vector_environment_without_infos_has_no_facts() -> None:
    run = msgspec.structs.replace(run_of("CartPole-v1", T=100), vector="native", info_keys=("is_success",))
    (rollout,) = collect(random_collector(run), run)
    assert rollout.episodes
    assert all(math.isnan(row[0]) for row in facts(rollout))
