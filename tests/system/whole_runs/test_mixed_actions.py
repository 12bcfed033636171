"""Runs whose actions are a Tuple: PPO learns all parts, with the same bits for any number of workers and whoever is lost."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.learner.run_folder.progress import Progress
from tests.support.envs.toy import Steer
from tests.system.stage.local_runs import TOY, run
from tests.system.stage.run_folders import folder_of, policy_of, summary

ENV = f"{TOY}Steer-v0"
LEARNS: dict[str, Any] = {
    "algo": "ppo", "preset": "none", "lanes": 4, "envs": 4, "rollout_steps": 32, "net": (32,), "learning_rate": 0.01,
    "batch_size": 128, "n_epochs": 5, "gamma": 0.5, "steps": 15_000, "seed": 3, "eval_episodes": 10,
}  # fmt: skip
SMALL: dict[str, Any] = {**LEARNS, "n_epochs": 1, "rollout_steps": 16, "steps": 1_500, "eval_episodes": 2}
RANDOM = -10  # about the return of a policy at random; 10 is the most
LEARNED = 8


def test_ppo_learns_every_part(tmp_path: Path) -> None:
    folder = run(tmp_path, ENV, workers=1, transport="inproc", **LEARNS)
    assert summary(folder)["evaluation"]["return_mean"] > LEARNED
    policy = millrace.load(folder)
    number, choice = policy(np.eye(4, dtype=np.float32))
    assert choice.tolist() == [1, 2, 3, 4]
    assert np.abs(number[:, 0] - np.linspace(-1, 1, 4)).max() < 0.5
    one_number, one_choice = policy(np.eye(4, dtype=np.float32)[2])
    assert (one_number.shape, one_number.dtype, int(one_choice)) == ((1,), np.float32, 3)


class Dies(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Ends its process once, in the middle of an episode."""

    def __init__(self, env: Any, died: Path) -> None:
        super().__init__(env)
        copy = millrace.env_copy()
        self.steps, self.died, self.dies = 0, died, copy.lane == 1 and not copy.evaluation

    def step(self, action: Any) -> Any:
        self.steps += 1
        if self.dies and self.steps == 45 and not self.died.exists():
            self.died.touch()
            os._exit(1)
        return self.env.step(action)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with one worker, which nothing has disturbed."""
    return run(tmp_path_factory.mktemp("alone"), ENV, workers=1, transport="inproc", **SMALL)


@pytest.mark.parametrize("workers", [2, 4])
def test_the_bits_are_the_same_for_any_number_of_workers(tmp_path: Path, alone: Path, workers: int) -> None:
    folder = run(tmp_path, ENV, workers=workers, transport="inproc", **SMALL)
    assert policy_of(folder) == policy_of(alone)
    assert summary(folder)["evaluation"] == summary(alone)["evaluation"]


def test_they_are_if_a_worker_dies_and_its_lanes_are_brought_back(tmp_path: Path, alone: Path) -> None:
    died = tmp_path / "died"
    folder = millrace.train(
        lambda: Dies(Steer(), died), run_dir=str(tmp_path / "runs"), workers=2, progress=False, **SMALL
    ).path
    assert died.exists()
    assert summary(folder)["ledger"]["lost"] > 0
    assert policy_of(folder) == policy_of(alone)


def test_they_are_after_a_resume(tmp_path: Path, alone: Path) -> None:
    def stops(progress: Progress) -> None:
        if progress.updates == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, ENV, stops, workers=1, transport="inproc", **SMALL)
    (runs,) = tmp_path.glob("runs*")
    folder = run(tmp_path, "", resume=folder_of(runs), workers=2)
    assert policy_of(folder) == policy_of(alone)


@pytest.mark.parametrize("algo", ["a2c", "impala", "reinforce"])
def test_the_other_on_policy_algorithms_train(tmp_path: Path, algo: str) -> None:
    settings = {name: SMALL[name] for name in ("lanes", "envs", "net", "rollout_steps", "steps", "seed", "eval_episodes")}
    folder = run(tmp_path, ENV, workers=1, transport="inproc", algo=algo, preset="none", **settings)
    assert summary(folder)["updates"] > 1


@pytest.mark.parametrize("algo", ["dqn", "sac", "td3", "tqc", "crossq", "xqc"])
def test_all_others_refuse_in_a_line_that_names_the_way(tmp_path: Path, algo: str) -> None:
    with pytest.raises(millrace.UsageError, match=rf"^{algo}: expected .*, got a Dict or Tuple; take --algo ppo for it$"):
        run(tmp_path, ENV, workers=1, transport="inproc", algo=algo, preset="none", steps=100)


def test_a_dataset_of_them_keeps_the_tuple_and_trains_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    recorded = run(tmp_path, ENV, workers=1, transport="inproc", record="steer/training-v0", **SMALL)
    dataset = minari.load_dataset("steer/training-v0")
    space = Steer().action_space
    assert dataset.action_space == space
    for episode in dataset.iterate_episodes(range(3)):
        numbers, choices = episode.actions
        assert all(space.contains((number, choice)) for number, choice in zip(numbers, choices, strict=True))
        assert len(choices) == len(episode.rewards) == 10
    cloned = run(
        tmp_path, ENV, workers=1, transport="inproc", prior="steer/training-v0", clone_epochs=2, **{**SMALL, "steps": 128}
    )
    first = json.loads((cloned / "metrics.jsonl").read_text().splitlines()[0])
    assert 0 < first["clone/accuracy"] < 1
    assert 0 < first["clone/mean_absolute_error"] < 2
    assert policy_of(cloned) != policy_of(recorded)
