"""examples/tasks_by_number.py: env copies with different tasks, and the same bits for any number of workers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import millrace
from examples import tasks_by_number
from millrace.learner.run_folder.metrics_log import read_rows
from tests.system.stage.run_folders import policy_of

SMALL: dict[str, Any] = {
    "transport": "inproc", "rollout_steps": 32, "n_epochs": 1, "net": (8,), "steps": 1_000, "eval_episodes": 8,
    "eval_every": 500, "seed": 3, "progress": False,
}  # fmt: skip
RETURNS = [f"return_{task}" for task in tasks_by_number.POLES]


def train(folder: Path, workers: int, **settings: Any) -> Path:
    return tasks_by_number.train(run_dir=str(folder), workers=workers, **{**SMALL, **settings}).path


def result(folder: Path) -> tuple[bytes, object]:
    """The policy, and the evaluation."""
    return policy_of(folder), json.loads((folder / "summary.json").read_text())["evaluation"]


@pytest.fixture(scope="module")
def one_worker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("one"), 1)


def test_returns_by_task_are_metrics(one_worker: Path) -> None:
    rows = read_rows(one_worker / "metrics.jsonl")
    assert all(rows[-1][f"rollout/{name}"] > 8 for name in RETURNS)
    evaluated = [row for row in rows if f"eval/{RETURNS[0]}" in row]
    assert [[row[f"eval/{name}_missing"] for name in RETURNS] for row in evaluated] == [[6] * 4], "2 of 8 are of each task"


@pytest.mark.parametrize(
    ("workers", "settings"),
    [(2, {}), (4, {"transport": "ipc"}), (2, {"inference": "learner"})],
    ids=["two", "four", "inference learner"],
)
def test_the_bits_are_the_same_for_any_number_of_workers(
    tmp_path: Path, one_worker: Path, workers: int, settings: dict[str, Any]
) -> None:
    assert result(train(tmp_path, workers, **settings)) == result(one_worker)


def test_a_saved_policy_is_evaluated_on_the_same_tasks_wherever_it_acts(one_worker: Path) -> None:
    in_workers, in_learner = (
        millrace.evaluate(one_worker, episodes=8, workers=1, transport="inproc", copies=4, inference=inference)
        for inference in ("workers", "learner")
    )
    assert in_learner == in_workers
    assert [in_workers.facts[name].missing for name in RETURNS] == [6] * 4


def test_without_the_tasks_the_bits_are_others(tmp_path: Path, one_worker: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks_by_number, "POLES", dict.fromkeys(tasks_by_number.POLES, 0.5))
    assert result(train(tmp_path, 1)) != result(one_worker)


def test_a_resumed_run_has_the_same_bits_for_any_number_of_workers(tmp_path: Path, one_worker: Path) -> None:
    found = []
    for workers in (1, 2, 4):
        folder = tmp_path / str(workers)
        shutil.copytree(one_worker, folder)
        run = millrace.train(resume=folder, workers=workers, steps=2_000, progress=False)
        found.append(result(run.path))
    assert found[1:] == found[:1] * 2
    assert found[0] != result(one_worker)
