"""A run that is resumed with other lanes or env copies: for every algorithm it goes on, and its ledger balances."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest

from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UsageError
from tests.learner.config.test_resume_rules import content
from tests.system.stage.run_folders import saved_rollouts, summary
from tests.system.stage.runs import balanced

GRADIENT_STEPS = 5
SHAPES: dict[str, tuple[int, int]] = {  # lanes and envs
    "fewer lanes": (2, 8),
    "one lane": (1, 3),
    "more lanes": (8, 8),
    "more copies": (4, 16),
    "fewer copies": (4, 4),
}
ALGORITHMS: dict[str, dict[str, Any]] = {
    "ppo": {"algo": "ppo", "rollout_steps": 16, "normalize_rewards": True, "normalize_observations": True, "n_epochs": 1},
    "ppo with lag": {"algo": "ppo", "rollout_steps": 16, "normalize_rewards": True, "n_epochs": 1, "max_lag": 1},
    "lstm": {"algo": "ppo", "rollout_steps": 16, "core": "lstm", "core_size": 8, "n_epochs": 1},
    "a2c": {"algo": "a2c", "rollout_steps": 16, "normalize_rewards": True},
    "dqn": {
        "algo": "dqn", "rollout_steps": 16, "learning_starts": 0, "gradient_steps": GRADIENT_STEPS, "batch_size": 8,
        "replay_size": 400, "priority_alpha": 0.6, "n_step": 3, "max_lag": 1,
    },
    "impala": {"algo": "impala", "rollout_steps": 16, "normalize_rewards": True, "max_lag": 2},
    "reinforce": {"algo": "reinforce", "rollout_steps": 501},
}  # fmt: skip


def silent(progress: object) -> None:
    """Show nothing."""


def goes_on_with(tmp_path: Path, algorithm: str, shapes: list[tuple[int, int]]) -> None:
    """Train for five updates with 4 lanes and 8 envs, then for five more with each of these shapes."""
    settings = ALGORITHMS[algorithm]
    T = settings["rollout_steps"]
    given: dict[str, Any] = {"transport": "inproc", "workers": 1, "eval_episodes": 1, "run_dir": str(tmp_path), "net": (8,)}
    run = train(resolve("CartPole-v1", preset="none", steps=5 * T * 8, **given, **settings), None, silent)
    max_lag = settings.get("max_lag", 0)
    used = 4 * summary(run)["updates"]
    for lanes, envs in shapes:
        before, old = summary(run), saved_rollouts(run).incarnations
        steps = before["env_steps"] + 5 * T * envs
        assert train(resolve(resume=run, steps=steps, lanes=lanes, envs=envs), run, silent) == run
        now, new = summary(run), saved_rollouts(run).incarnations
        updates = now["updates"] - before["updates"]
        assert updates >= 5, "it does not go on"
        ledger, used = balanced(now), used + lanes * updates
        assert ledger["used"] == used, "an update was not made of one rollout of each lane"
        assert ledger["transitions_used"] == now["env_steps"]
        assert ledger["outstanding"] <= lanes * (1 + max_lag), "more tickets than lanes and max_lag allow"
        for lane in range(max(len(old), lanes)):
            had = old[lane] if lane < len(old) else 0
            has = new[lane]
            assert has > had if lane < lanes else has == had, f"lane {lane}: incarnation {had}, then {has}"
        rows = [row for row in read_rows(run / "metrics.jsonl") if row["time/iterations"] > before["updates"]]
        assert [row["time/iterations"] for row in rows] == list(range(before["updates"] + 1, now["updates"] + 1))
        assert all(row["lag/max"] <= max_lag for row in rows)
        for row, following in itertools.pairwise(rows):
            made = following["time/total_timesteps"] - row["time/total_timesteps"]
            assert T * envs * 0.8 <= made <= T * envs, "an update is not one rollout of each of these env copies"
            if settings["algo"] == "dqn":
                assert following["train/n_updates"] - row["train/n_updates"] == GRADIENT_STEPS
                assert following["replay/env_steps_per_gradient_step"] == made / GRADIENT_STEPS


def test_ppo_goes_on_with_fewer_lanes_and_then_with_more(tmp_path: Path) -> None:
    goes_on_with(tmp_path, "ppo", [SHAPES["fewer lanes"], SHAPES["more copies"]])


@pytest.mark.soak
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_goes_on_with_another_shape_and_then_with_its_own(
    tmp_path: Path, algorithm: str, shape: str
) -> None:
    goes_on_with(tmp_path, algorithm, [SHAPES[shape], (4, 8)])


def test_what_is_refused_leaves_the_folder_as_it_was_and_a_plain_resume_goes_on(tmp_path: Path) -> None:
    given: dict[str, Any] = {
        "transport": "inproc",
        "workers": 1,
        "eval_episodes": 1,
        "run_dir": str(tmp_path),
        "net": (8,),
        "n_epochs": 1,
    }
    run = train(resolve("CartPole-v1", preset="none", steps=1_024, rollout_steps=64, **given), None, silent)
    before = content(run)
    others: list[dict[str, Any]] = [{"algo": "a2c"}, {"activation": "relu"}, {"seed": 2}, {"net": (9,)}, {"core": "gru"}]
    for changed in others:
        with pytest.raises(UsageError, match="a run keeps this setting"):
            train(resolve(resume=run, steps=4_096, **changed), run, silent)
    assert content(run) == before
    train(resolve(resume=run, steps=2_048), run, silent)
    assert summary(run)["env_steps"] > 1_024


class Changing(gymnasium.Env[Any, Any]):
    """An environment whose observations grow by one number with its next version."""

    size: ClassVar[int] = 3

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-1, 1, (self.size,))
        self.action_space = gymnasium.spaces.Discrete(2)
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return np.zeros(self.size, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        return np.zeros(self.size, np.float32), 1.0, self._steps == 5, False, {}


def test_an_environment_whose_spaces_have_changed_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {"transport": "inproc", "workers": 1, "eval_episodes": 1, "run_dir": str(tmp_path), "net": (8,)}
    run = train(
        resolve(EnvSpec.of(Changing).id, steps=1_024, rollout_steps=32, n_epochs=1, **given),
        None,
        silent,
        EnvSpec.of(Changing),
    )
    before = content(run)
    monkeypatch.setattr(Changing, "size", 4)
    says = (
        rf"^run {run}: the environment's observations have changed: expected .*\(3,\).*, got .*\(4,\).*; install the version"
    )
    with pytest.raises(UsageError, match=says) as why:
        train(resolve(resume=run, steps=2_048), run, silent, EnvSpec.of(Changing))
    assert "\n" not in str(why.value)
    assert content(run) == before
    monkeypatch.setattr(Changing, "size", 3)
    train(resolve(resume=run, steps=2_048), run, silent, EnvSpec.of(Changing))
    assert summary(run)["env_steps"] > 1_024
