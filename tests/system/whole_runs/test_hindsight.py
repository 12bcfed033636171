"""Whole runs with hindsight: the same for any number of workers; what the environment must be, and what ends a run."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest

from millrace.launch.training import train
from millrace.learner.config.hyperparameters import algorithms_with
from millrace.learner.config.layers import resolve
from millrace.protocol.errors import UsageError
from tests.system.stage.run_folders import policy_of

REACH = "tests.support.envs.reach:Reach-v0"
SMALL: dict[str, Any] = {
    "algo": "sac",
    "preset": "none",
    "transport": "inproc",
    "seed": 3,
    "envs": 8,
    "lanes": 4,
    "rollout_steps": 5,
    "learning_starts": 90,
    "batch_size": 16,
    "net": (16,),
    "eval_episodes": 1,
    "steps": 400,
    "hindsight": 0.8,
    "goal_reward": "sparse:0.1",
}
CONTINUOUS: dict[str, Any] = {"updates_per_step": 0.3}
OWN: dict[str, dict[str, Any]] = {
    "dqn": {"gradient_steps": 12, "env_kwargs": {"discrete": True}},
    "sac": CONTINUOUS,
    "td3": CONTINUOUS,
    "tqc": CONTINUOUS | {"quantiles": 5},
    "crossq": CONTINUOUS | {"critic_net": (16,), "policy_delay": 2},
    "xqc": CONTINUOUS | {"critic_net": (16,), "policy_delay": 2, "atoms": 21},
}
ALGORITHMS = [algo if algo in ("sac", "dqn") else pytest.param(algo, marks=pytest.mark.soak) for algo in OWN]


def run(tmp_path: Path, name: str, env: str = REACH, **settings: Any) -> Path:
    keywords = SMALL | settings
    return train(resolve(env, run_dir=str(tmp_path / name), **keywords), None, lambda _: None)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_bits_do_not_depend_on_the_number_of_workers(tmp_path: Path, algo: str) -> None:
    found = [policy_of(run(tmp_path, f"{workers}", algo=algo, workers=workers, **OWN[algo])) for workers in (1, 2, 4)]
    assert found[0] == found[1] == found[2]
    assert found[0] != policy_of(run(tmp_path, "off", algo=algo, workers=1, **OWN[algo] | {"hindsight": 0.0}))


@pytest.mark.parametrize(
    ("kwargs", "settings", "expected"),
    [
        (
            {},
            {"goal_reward": "sparse:0.9"},
            r"^goal_reward sparse:0.9: lane \d, column \d, step \d of its rollout: expected 0 .*",
        ),
        (
            {"scale": 0.1},
            {},
            r"^goal_reward sparse:0.1: lane .*: expected -1 .* got -0.1 from the environment; name the func",
        ),
        ({"reward": "success"}, {}, r"^goal_reward sparse:0.1: .* expected -1 .* got 0 from the environment; "),
        (
            {"within": 2.0, "ends": True},
            {"goal_reward": "sparse:2"},
            r"^goal_ends none: .* got its end; take --goal-ends 2 if",
        ),
    ],
)
def test_a_reward_that_is_not_that_of_the_environment_ends_the_run_in_one_line(
    tmp_path: Path, kwargs: dict[str, Any], settings: dict[str, Any], expected: str
) -> None:
    with pytest.raises(UsageError, match=expected) as refused:
        run(tmp_path, "wrong", workers=1, env_kwargs=kwargs, **settings)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("reward", ["success:0.1", "dense"])
def test_the_other_rewards_are_those_of_such_environments(tmp_path: Path, reward: str) -> None:
    kwargs = {"reward": reward.partition(":")[0]}
    run(tmp_path, "right", workers=1, steps=160, env_kwargs=kwargs, goal_reward=reward)


def test_a_run_that_cannot_have_hindsight_is_refused_before_it_begins(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^hindsight 0.8: expected a Dict observation with achieved_goal and desired_goal"):
        run(tmp_path, "no goals", "Pendulum-v1", workers=1)
    with pytest.raises(UsageError, match=r"^hindsight 0.8: expected the reward of a goal, got none; name it, as in "):
        run(tmp_path, "no reward", workers=1, goal_reward=None)
    with pytest.raises(UsageError, match=f"hindsight.*{algorithms_with('hindsight')}"):
        resolve(REACH, algo="ppo", hindsight=0.8)
    assert not [*tmp_path.glob("*/*")]


def test_a_run_that_does_not_use_its_goals_is_told_so_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        run(tmp_path, "off", workers=1, steps=80, hindsight=0.0)
    lines = [record.message for record in caplog.records if "shows an achieved and a desired goal" in record.message]
    assert len(lines) == 1
