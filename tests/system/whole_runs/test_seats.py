"""Runs with several agents, whole: known values, the same bits for any number of workers, resuming, evaluations."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
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
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_setup import check_evaluation_spaces
from millrace.protocol.arrays import Floats
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.recurrent import zero_state
from tests.support.in_process.saved_policies import load_policy
from tests.support.users_code.seat_envs import CHAIN_REWARD, MOVES, values_of_the_chain
from tests.system.stage.run_folders import folder_of, policy_of

ENVS = "tests.support.users_code.seat_envs:"
GAMMA = 0.9


SMALL: dict[str, Any] = {"preset": "none", "transport": "inproc", "seed": 1, "workers": 1, "eval_episodes": 1}
RAW: dict[str, Any] = {"gamma": GAMMA, "normalize_observations": False, "normalize_rewards": False}


def silent(progress: Progress) -> None:
    """Show nothing."""


def trained(
    path: Path, env: str, resume: Path | None = None, watch: Callable[[Progress], None] = silent, **settings: Any
) -> Path:
    return train(resolve(f"{ENVS}{env}", resume=resume, run_dir=str(path), **SMALL | settings), resume, watch)


def each_observation() -> Floats:
    return np.eye(sum(MOVES.values()), dtype=np.float32)


def value_of_each(run: Path) -> Floats:
    """What the critic of a run of PPO says of each observation of the chain."""
    algorithm = algorithm_class("ppo")(PPOConfig(), saved_policy(run).card.policy, total_steps=1, seed=1)
    algorithm.load_state_dict(checkpoint.newest(run)[0].state["algorithm"])
    with torch.no_grad():
        return algorithm.net.value(torch.from_numpy(each_observation())).numpy()  # type: ignore[attr-defined, no-any-return]


def best_of_each(run: Path) -> Floats:
    """What a run of DQN says of the better action in each."""
    policy, spec, _ = load_policy(run)
    obs = each_observation()[None]
    return np.asarray(policy([obs], zero_state(spec, *obs.shape[:2]))[0, :, :2].max(-1))  # the last is ε


@pytest.mark.parametrize("env", ["ChainGame", "ChainCrowd"])
def test_ppo_reaches_the_known_values_of_agents_of_which_one_leaves(tmp_path: Path, env: str) -> None:
    settings: dict[str, Any] = {"learning_rate": 5e-3, "learning_rate_schedule": "linear", "rollout_steps": 32}
    run = trained(tmp_path, env, steps=5_000, n_epochs=4, **RAW, **settings)
    np.testing.assert_allclose(value_of_each(run), values_of_the_chain(GAMMA), atol=0.01)


@pytest.mark.parametrize(("env", "n_step"), [("ChainGame", 1), ("ChainCrowd", 1), ("ChainCrowd", 3)])
def test_so_does_dqn(tmp_path: Path, env: str, n_step: int) -> None:
    settings: dict[str, Any] = {"learning_rate": 3e-3, "learning_starts": 200, "gradient_steps": 64, "target_every": 100}
    run = trained(
        tmp_path, env, algo="dqn", steps=5_000, rollout_steps=32, epsilon_end=1.0, n_step=n_step, **RAW, **settings
    )
    np.testing.assert_allclose(best_of_each(run), values_of_the_chain(GAMMA), atol=0.05)


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        ("RandomGame", {"max_lag": 1, "normalize_observations": True}),
        ("RandomGame", {"core": "gru", "net": (8,), "n_epochs": 1}),
        ("RandomCrowd", {"algo": "impala", "max_lag": 2}),
        ("RandomCrowd", {"algo": "dqn", "n_step": 3, "learning_starts": 200}),
    ],
)
def test_the_weights_do_not_depend_on_the_number_of_workers(tmp_path: Path, env: str, settings: dict[str, Any]) -> None:
    settings |= {"steps": 800, "rollout_steps": 16}
    policies = [policy_of(trained(tmp_path / str(n), env, workers=n, **settings)) for n in (1, 3)]
    assert policies[0] == policies[1]


def test_a_resumed_run_goes_on_alike_with_any_number_of_workers(tmp_path: Path) -> None:
    """Seats that waited when it was interrupted begin anew, as all lanes do."""

    def stops(progress: Progress) -> None:
        if progress.updates == 5:
            raise KeyboardInterrupt

    settings: dict[str, Any] = {"steps": 1_200, "rollout_steps": 16, "normalize_rewards": True, "max_lag": 1}
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "first", "RandomGame", watch=stops, **settings)
    first = folder_of(tmp_path / "first")
    policies = []
    for workers in (1, 3):
        again = tmp_path / str(workers) / first.name
        shutil.copytree(first, again)
        policies.append(policy_of(trained(again.parent, "RandomGame", again, workers=workers, **settings)))
    assert policies[0] == policies[1]


def test_an_episode_has_the_return_of_each_agent_and_their_sum(tmp_path: Path) -> None:
    run = trained(tmp_path, "ChainGame", steps=500, rollout_steps=16, eval_episodes=3)
    totals = {agent: sum(rewards) for agent, rewards in CHAIN_REWARD.items()}
    summary = json.loads((run / "summary.json").read_text())
    for returns, facts in (
        (summary["return_mean_100"], summary["facts_100"]),
        (summary["evaluation"]["return_mean"], summary["evaluation"]["facts"]),
    ):
        assert returns == sum(totals.values())
        assert {name: each["mean"] for name, each in facts.items()} == {f"return_{agent}": totals[agent] for agent in totals}
    assert summary["evaluation"]["length_mean"] == sum(MOVES.values())


@pytest.mark.parametrize("env", ["ChainGame", "ChainCrowd"])
def test_each_agent_can_be_told_which_one_it_is(tmp_path: Path, env: str) -> None:
    run = trained(tmp_path, env, steps=300, rollout_steps=16, seat_id=True)
    leaves = saved_policy(run).card.policy.observation
    assert [(leaf.path, leaf.kind, leaf.sizes) for leaf in leaves] == [
        ("observation", "box", ()),
        ("seat", "discrete", (2,)),
    ]
    for wrappers in (None, [same]):  # other wrappers don't take the agent's number away
        evaluation = millrace.evaluate(run, episodes=1, wrappers=wrappers)
        assert evaluation.facts["return_long"].mean == sum(CHAIN_REWARD["long"])


def same(env: Any) -> Any:
    return env


@pytest.mark.parametrize(
    ("env", "settings", "says"),
    [
        ("ChainGame", {"inference": "learner"}, "inference learner: .*ChainGame has several agents, and workers must act"),
        ("ChainGame", {"vector": "native"}, "vector native: .*ChainGame has several agents, whose copies are looped"),
        ("ChainGame", {"record": "a/b-v0"}, "record: expected none, because .*ChainGame has several agents"),
        (
            "Unequal",
            {},
            "expected one action space for all agents, got .* for a and .* for b; .*supersuit:pad_action_space_v0",
        ),
    ],
)
def test_what_several_agents_cannot_have_is_refused_in_a_line(
    tmp_path: Path, env: str, settings: dict[str, Any], says: str
) -> None:
    with pytest.raises(UsageError, match=says):
        trained(tmp_path, env, steps=300, **settings)


def test_a_run_is_not_resumed_with_other_agents(tmp_path: Path) -> None:
    run = trained(tmp_path, "ChainGame", steps=300, rollout_steps=16)
    card = run / "policy.json"
    saved = json.loads(card.read_text())
    card.write_text(json.dumps(saved | {"seats": ["short", "tall"]}))
    with pytest.raises(UsageError, match=r"agents have changed: expected \('short', 'tall'\), got \('short', 'long'\)"):
        trained(tmp_path, "ChainGame", run, steps=600, rollout_steps=16)


def test_an_evaluation_has_the_agents_of_training() -> None:
    none = DescribedEnv(gymnasium.spaces.Box(0, 1), gymnasium.spaces.Discrete(2))
    two = replace(none, seats=("a", "b"))
    turns = replace(two, takes_turns=True)
    config = resolve("ChainGame")
    check_evaluation_spaces(config, two, two)
    for other, got in ((turns, "agents that take turns: a, b"), (none, "agents: none")):
        with pytest.raises(UsageError, match=f"^eval_env_kwargs: expected the agents of training, agents: a, b; got {got}$"):
            check_evaluation_spaces(config, two, other)
    many, others = (replace(none, seats=(*(f"agent_{n}" for n in range(99)), last)) for last in ("a", "b"))
    with pytest.raises(UsageError, match=r"^eval_env_kwargs: expected the agents of training"):
        check_evaluation_spaces(config, many, others)


def test_so_is_what_a_saved_policy_of_theirs_cannot_do(tmp_path: Path) -> None:
    run = trained(tmp_path, "ChainGame", steps=100, rollout_steps=16)
    with pytest.raises(UsageError, match=r"^inference learner: .*ChainGame has several agents, and workers must act"):
        millrace.evaluate(run, episodes=1, inference="learner")
    with pytest.raises(UsageError, match=r"^record: .*ChainGame has several agents, which a dataset can't have"):
        millrace.record(run, "some/data-v0", steps=10)
