"""examples/curriculum.py and examples/optuna_sweep.py. The second with a small module in place of optuna, and with optuna
where it is installed.
"""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from millrace.learner.run_folder.metrics_log import read_rows

SMALL: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "lanes": 2, "envs": 4, "rollout_steps": 64, "n_epochs": 4, "net": (16,),
    "progress": False, "preset": "none",
}  # fmt: skip


def test_the_curriculum_grows_and_a_resumed_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from examples import curriculum

    monkeypatch.setattr(curriculum, "ENOUGH", 15.0)
    run = curriculum.train(run_dir=str(tmp_path), steps=6_000, eval_episodes=2, **SMALL)
    poles = [row["custom/pole"] for row in read_rows(run.path / "metrics.jsonl")]
    assert poles[0] == 0.5
    assert poles[-1] == 2.0
    assert poles == sorted(poles)
    assert set(poles) == {0.5, 1.0, 1.5, 2.0}


class Trial:
    """Prunes the second trial at its second evaluation."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.reports: list[tuple[float, int]] = []

    def suggest_float(self, name: str, low: float, high: float, log: bool) -> float:
        return low

    def suggest_categorical(self, name: str, choices: list[float]) -> float:
        return choices[0]

    def report(self, value: float, step: int) -> None:
        self.reports.append((value, step))

    def should_prune(self) -> bool:
        return self.number == 1 and len(self.reports) == 2


class TrialPruned(Exception):
    pass


def test_the_sweep_over_seeds_with_pruning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", SimpleNamespace(Trial=Trial, TrialPruned=TrialPruned, Study=object))
    monkeypatch.delitem(sys.modules, "examples.optuna_sweep", raising=False)
    example = importlib.import_module("examples.optuna_sweep")
    settings = {**SMALL, "steps": 1_000, "eval_episodes": 2, "run_dir": str(tmp_path)}
    whole, pruned = Trial(0), Trial(1)
    assert example.objective(whole, **settings) > 5.0
    assert len(list(tmp_path.glob("CartPole*"))) == 3
    steps = [step for _, step in whole.reports]
    assert steps == sorted(set(steps)), "optuna takes one value for a step"
    assert len(steps) >= 12
    with pytest.raises(TrialPruned):
        example.objective(pruned, **settings)
    folders = sorted(tmp_path.glob("CartPole*"), key=lambda folder: (folder / "summary.json").stat().st_mtime_ns)
    assert len(folders) == 4, "no other seed is begun"
    assert '"ended by Prune.on_evaluation"' in (folders[-1] / "summary.json").read_text().replace('":"', '": "')
    monkeypatch.delitem(sys.modules, "examples.optuna_sweep")


@pytest.mark.skipif(find_spec("optuna") is None, reason="optuna is not here: pip install optuna")
def test_the_sweep_with_optuna(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from examples import optuna_sweep

    settings = {**SMALL, "steps": 600, "eval_episodes": 2, "run_dir": str(tmp_path)}
    study = optuna_sweep.sweep(6, **settings)
    states = [trial.state.name for trial in study.trials]
    assert set(states) <= {"COMPLETE", "PRUNED"}
    assert states[:2] == ["COMPLETE"] * 2
    assert study.best_value > 5.0
