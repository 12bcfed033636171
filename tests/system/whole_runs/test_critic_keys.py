"""Observations that only the critic sees: it learns from them, and the policy acts, is saved and loaded without them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import millrace
from millrace.launch.training import train
from millrace.learner.algorithms import algorithm_class
from millrace.learner.config.hyperparameters import PPOConfig
from millrace.learner.config.layers import resolve
from millrace.learner.policy_player import saved_policy
from millrace.learner.run_folder import checkpoint
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.encoder import RecurrentInput
from millrace.protocol.policy.layout import acting_size
from tests.support.users_code.hidden_envs import REWARDS
from tests.system.stage.run_folders import policy_of

USERS = "tests.support.users_code."
SMALL: dict[str, Any] = {"preset": "none", "transport": "inproc", "seed": 1, "eval_episodes": 2, "critic_keys": ["hidden"]}
RAW: dict[str, Any] = {"normalize_observations": False, "normalize_rewards": False}


def trained(path: Path, env: str = "hidden_envs:Hidden", **settings: Any) -> Path:
    return train(resolve(f"{USERS}{env}", run_dir=str(path), **SMALL | settings), None, lambda _: None)


@pytest.mark.parametrize("core", [None, "gru"])
def test_the_critic_knows_what_the_actor_does_not_see(tmp_path: Path, core: Any) -> None:
    run = trained(tmp_path, steps=2_500, rollout_steps=16, learning_rate=5e-3, n_epochs=4, core=core, core_size=8, **RAW)
    algorithm = algorithm_class("ppo")(PPOConfig(), saved_policy(run).card.policy, total_steps=1, seed=1)
    algorithm.load_state_dict(checkpoint.newest(run)[0].state["algorithm"])
    rows = torch.tensor([[0.5, -0.5, *hidden] for hidden in np.eye(len(REWARDS))], dtype=torch.float32)
    with torch.no_grad():
        net = algorithm.net  # type: ignore[attr-defined]
        recurrent = (
            None if core is None else RecurrentInput(torch.zeros(len(rows), net.spec.state_size), torch.ones(1, len(rows)))
        )
        params, value = net.forward(rows, (), recurrent)
        # Other hidden numbers for each row: at the same place of a batch, a processor computes the same bits.
        others, _ = net.forward(torch.cat([rows[:, :2], rows[:, 2:].roll(1, 0)], 1), (), recurrent)
    np.testing.assert_allclose(value.numpy(), REWARDS, atol=0.1)
    assert (params == others).all(), "the actor's distribution depends on what it does not see"


def test_a_policy_is_saved_loaded_and_evaluated_without_them(tmp_path: Path) -> None:
    run = trained(tmp_path, steps=300, rollout_steps=16)
    spec = saved_policy(run).card.policy
    assert [leaf.path for leaf in spec.observation] == ["seen"]
    arrays = sum(array.size for array in saved_policy(run).stored.parameters[None])
    assert arrays == acting_size(spec) == (2 * 64 + 64) + (64 * 64 + 64) + (64 * 2 + 2)
    policy = millrace.load(run)
    assert policy({"seen": np.array([0.5, -0.5], np.float32)}) in (0, 1)
    assert millrace.evaluate(run, episodes=4).episodes == 4
    with pytest.raises(UsageError, match=r"^record: the run has critic_keys, which a dataset can't have"):
        millrace.record(run, "some/data-v0", steps=10)


@pytest.mark.parametrize("settings", [{"max_lag": 1}, {"algo": "impala", "core": "lstm", "core_size": 8, "net": (8,)}])
def test_the_weights_do_not_depend_on_the_number_of_workers(tmp_path: Path, settings: dict[str, Any]) -> None:
    settings |= {"steps": 800, "rollout_steps": 16}
    policies = [policy_of(trained(tmp_path / str(n), workers=n, **settings)) for n in (1, 3)]
    assert policies[0] == policies[1]


def test_several_agents_have_the_state_of_their_environment(tmp_path: Path) -> None:
    run = trained(tmp_path, "seat_envs:ChainCrowd", steps=300, rollout_steps=16, critic_keys=["state"])
    spec = saved_policy(run).card.policy
    assert [(leaf.path, leaf.shape) for leaf in (*spec.observation, *spec.critic)] == [
        ("observation", (9,)),
        ("state", (2,)),
    ]
    with pytest.raises(UsageError, match="ChainGame: critic_keys state: expected a method state"):
        trained(tmp_path, "seat_envs:ChainGame", steps=300, rollout_steps=16, critic_keys=["state"])


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"critic_keys": ["other"]}, "critic_keys other: no key other; its keys are"),
        (
            {"critic_keys": ["hidden", "seen"]},
            "critic_keys hidden seen: expected one more key of the observation for the actor",
        ),
        ({"algo": "dqn"}, "critic_keys: expected an algorithm whose critic is a network of its own, got dqn"),
        ({"shared_net": True}, "got ppo with shared_net"),
        ({"inference": "learner"}, "inference learner: the run has critic_keys, and workers must act"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(tmp_path: Path, settings: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        trained(tmp_path, steps=300, **settings)
