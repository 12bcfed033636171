"""TorchRL's `GymWrapper` over `millrace.make_vec`: it accepts it, and its rollouts are those over gymnasium's own."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import pytest
import torch

import millrace

envs = pytest.importorskip("torchrl.envs", reason="TorchRL is not installed: pip install torchrl")

COPIES, STEPS, SEED = 3, 60, 5


def ours(env_id: str, mode: str) -> Any:
    return millrace.make_vec(env_id, COPIES, workers=2, transport="inproc", autoreset_mode=mode)


def gymnasiums(env_id: str, mode: str) -> Any:
    return gymnasium.vector.SyncVectorEnv([partial(gymnasium.make, env_id)] * COPIES, autoreset_mode=mode)


def rollout(made: Any) -> Any:
    """STEPS steps with random actions, [COPIES, STEPS]."""
    env = envs.GymWrapper(made)
    try:
        env.set_seed(SEED)
        torch.manual_seed(SEED)
        return env.rollout(STEPS, break_when_any_done=False)
    finally:
        env.close()


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_a_rollout_is_the_one_over_gymnasiums_vector_environment(env_id: str, mode: str) -> None:
    found, expected = rollout(ours(env_id, mode)), rollout(gymnasiums(env_id, mode))
    assert found.batch_size == (COPIES, STEPS)
    assert set(found.keys(True, True)) == set(expected.keys(True, True)) >= {"observation", "action", ("next", "reward")}
    for key in expected.keys(True, True):
        assert torch.equal(found[key], expected[key]), key
    if env_id == "CartPole-v1":
        assert found["next", "done"].any(), "no episode ended, so nothing was reset"


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_its_own_check_of_specs_passes(mode: str) -> None:
    env = envs.GymWrapper(ours("CartPole-v1", mode))
    try:
        envs.utils.check_env_specs(env)
    finally:
        env.close()


@pytest.mark.parametrize("make", [ours, gymnasiums])
def test_it_refuses_the_mode_that_gymnasium_has_by_default(make: Any) -> None:
    made = make("CartPole-v1", "NextStep")
    try:
        with pytest.raises(RuntimeError, match=r"must be one of SAME_STEP or DISABLED .*NEXT_STEP"):
            envs.GymWrapper(made)
    finally:
        made.close()
