"""The callbacks for wandb and MLflow, with small modules in their place: what they say, and that a resumed run goes on."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import millrace
from millrace.extras.monitoring.mlflow import MlflowCallback
from millrace.extras.monitoring.run_rows import RowFilter
from millrace.extras.monitoring.wandb import WandbCallback
from millrace.learner.run_folder.callback_requests import Requests
from millrace.learner.run_folder.progress import Progress

ENV = "tests.support.envs.toy:Identity-v0"
SMALL: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "lanes": 2, "envs": 2, "rollout_steps": 16, "n_epochs": 1, "net": (8,),
    "steps": 200, "eval_episodes": 2, "eval_every": 100, "progress": False,
}  # fmt: skip
STEPS = "time/total_timesteps"


class FakeWandbRun:
    """Keeps what it is told."""

    def __init__(self, init: dict[str, Any]) -> None:
        self.init = init
        self.rows: list[dict[str, float]] = []
        self.axes: list[tuple[str, str]] = []
        self.summary: dict[str, Any] = {}
        self.exit_code: int | None = None

    def define_metric(self, name: str, step_metric: str = "") -> None:
        self.axes.append((name, step_metric))

    def log(self, row: dict[str, float]) -> None:
        self.rows.append(row)

    def finish(self, exit_code: int) -> None:
        self.exit_code = exit_code


@pytest.fixture
def wandb_runs(monkeypatch: pytest.MonkeyPatch) -> list[FakeWandbRun]:
    runs: list[FakeWandbRun] = []

    def init(**given: Any) -> FakeWandbRun:
        runs.append(FakeWandbRun(given))
        return runs[-1]

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    return runs


def run(tmp_path: Path, callback: object, **settings: Any) -> Path:
    env = "" if "resume" in settings else ENV
    return Path(millrace.train(env, run_dir=str(tmp_path / "runs"), callbacks=[callback], **{**SMALL, **settings}))


def test_wandb(tmp_path: Path, wandb_runs: list[FakeWandbRun]) -> None:
    folder = run(tmp_path, WandbCallback(every_s=0.0, project="mine", mode="offline"))
    (told,) = wandb_runs
    assert told.init["project"] == "mine"
    assert told.init["mode"] == "offline"
    assert told.init["name"] == folder.name
    assert set(told.init["id"]) <= set(folder.name) | {"-"}
    assert told.init["config"]["algorithm.n_epochs"] == 1
    assert told.init["config"]["env"] == ENV
    assert told.axes == [(STEPS, ""), ("*", STEPS)]
    rows = [row for row in told.rows if "time/iterations" in row]
    updates = [row["time/iterations"] for row in rows]
    assert updates == list(range(1, len(updates) + 1))
    assert len(updates) > 5
    assert "train/value_loss" in rows[0]
    evaluations = [row[STEPS] for row in told.rows if "eval/mean_reward" in row]
    assert evaluations[0] >= 100
    assert evaluations == sorted(set(evaluations)), "each evaluation is sent once"
    assert all(isinstance(number, int | float) for row in told.rows for number in row.values())
    assert told.summary == {"stop_reason": "all steps done"}
    assert told.exit_code == 0
    run(tmp_path, WandbCallback(every_s=0.0), resume=folder, steps=300)
    _, again = wandb_runs
    assert (again.init["id"], again.init["resume"]) == (told.init["id"], "allow")
    assert next(row["time/iterations"] for row in again.rows) == updates[-1] + 1, "no row is sent twice"


def test_a_run_that_is_cut_short_is_marked(tmp_path: Path, wandb_runs: list[FakeWandbRun]) -> None:
    class Broken(millrace.Callback):
        def on_update(self, progress: Progress) -> None:
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        millrace.train(ENV, run_dir=str(tmp_path), callbacks=[WandbCallback(every_s=1e9), Broken()], **SMALL)
    (told,) = wandb_runs
    assert (told.exit_code, told.summary["stop_reason"]) == (1, "ValueError: no")
    assert [row["time/iterations"] for row in told.rows] == [1]


@pytest.mark.parametrize("every_s", [0.0, 1e9])
def test_numbers_of_callbacks_are_sent_with_a_row(tmp_path: Path, wandb_runs: list[FakeWandbRun], every_s: float) -> None:
    class Logs(millrace.Callback):
        def on_update(self, progress: Progress) -> None:
            progress.log("update", progress.updates)

        def on_evaluation(self, progress: Progress) -> None:
            progress.log("evaluated", progress.updates)

    callbacks = [Logs(), WandbCallback(every_s=every_s)]
    summary = millrace.train(ENV, run_dir=str(tmp_path), callbacks=callbacks, **SMALL).summary
    (told,) = wandb_runs
    rows = [row for row in told.rows if "time/iterations" in row]
    assert all(row["custom/update"] == row["time/iterations"] for row in rows)
    assert summary is not None
    assert rows[-1]["time/iterations"] == summary.updates
    evaluations = [row for row in told.rows if "eval/mean_reward" in row]
    assert len(evaluations) > 1
    assert all("custom/evaluated" in row for row in evaluations)


def test_what_a_tool_refuses_is_one_line_that_names_it_and_what_it_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wandb_runs: list[FakeWandbRun]
) -> None:
    def refuse(*arguments: object, **named: object) -> None:
        raise ValueError("1 validation error for Settings\nmode\n  expected 'online', got 'onlin'")

    says = "wandb: ValueError: 1 validation error for Settings mode expected 'online', got 'onlin'"
    monkeypatch.setattr(FakeWandbRun, "log", refuse)
    with pytest.raises(millrace.RunError) as later:
        run(tmp_path / "later", WandbCallback(every_s=0.0))
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=refuse))
    with pytest.raises(millrace.RunError) as at_once:
        run(tmp_path / "at once", WandbCallback())
    for error in (later.value, at_once.value):
        assert str(error) == says
        assert type(error.__cause__) is ValueError


class FakeMlflow:
    """As much of MLflow as the callback uses."""

    def __init__(self) -> None:
        self.experiments: dict[str, str] = {}
        self.runs: dict[str, Any] = {}
        self.entities = SimpleNamespace(
            Param=lambda key, value: (key, value), Metric=lambda key, value, at_ms, step: (self.allowed(key), value, step)
        )

    @staticmethod
    def allowed(name: str) -> str:
        """The name, which consists of the characters that MLflow allows."""
        assert re.fullmatch(r"[/\w.\- :]+", name)
        return name

    def MlflowClient(self, tracking_uri: str | None) -> FakeMlflow:  # the name in MLflow
        self.uri = tracking_uri
        return self

    def get_experiment_by_name(self, name: str) -> Any:
        return SimpleNamespace(experiment_id=self.experiments[name]) if name in self.experiments else None

    def create_experiment(self, name: str) -> str:
        self.experiments[name] = str(len(self.experiments))
        return self.experiments[name]

    def search_runs(self, experiments: list[str]) -> list[Any]:
        return list(self.runs.values())

    def create_run(self, experiment: str, tags: dict[str, str], run_name: str) -> Any:
        info = SimpleNamespace(run_id=str(len(self.runs)), name=run_name, status="RUNNING")
        made = SimpleNamespace(info=info, data=SimpleNamespace(tags=tags, params={}, metrics=[]))
        self.runs[info.run_id] = made
        return made

    def update_run(self, run: str, status: str) -> None:
        self.runs[run].info.status = status

    def log_batch(self, run: str, metrics: Any = (), params: Any = ()) -> None:
        assert len(params) <= 100
        self.runs[run].data.params |= dict(params)
        self.runs[run].data.metrics += metrics

    def set_tag(self, run: str, name: str, value: str) -> None:
        self.runs[run].data.tags[name] = value

    def set_terminated(self, run: str, status: str) -> None:
        self.runs[run].info.status = status


def test_mlflow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeMlflow()
    monkeypatch.setitem(sys.modules, "mlflow", fake)
    folder = run(tmp_path, MlflowCallback("mine", "sqlite:///x.db", every_s=0.0))
    assert (fake.uri, list(fake.experiments)) == ("sqlite:///x.db", ["mine"])
    (made,) = fake.runs.values()
    assert made.info.name == folder.name
    assert made.info.status == "FINISHED"
    assert made.data.params["algorithm.n_epochs"] == "1"
    assert made.data.tags["stop_reason"] == "all steps done"
    updates = [value for name, value, _ in made.data.metrics if name == "time/iterations"]
    assert updates == list(range(1, len(updates) + 1))
    assert all(value == step for name, value, step in made.data.metrics if name == STEPS)
    run(tmp_path, MlflowCallback("mine", every_s=0.0), resume=folder, steps=300)
    assert len(fake.runs) == 1, "a resumed run goes on in the same MLflow run"
    updates = [value for name, value, _ in made.data.metrics if name == "time/iterations"]
    assert updates == list(range(1, len(updates) + 1))


def test_names_that_mlflow_does_not_allow_are_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Logs(millrace.Callback):
        def on_update(self, progress: Progress) -> None:
            progress.log("success (%)", 1.0)

    fake = FakeMlflow()
    monkeypatch.setitem(sys.modules, "mlflow", fake)
    callbacks = [Logs(), MlflowCallback(every_s=0.0)]
    millrace.train(ENV, run_dir=str(tmp_path), callbacks=callbacks, **SMALL)
    (made,) = fake.runs.values()
    assert {name for name, *_ in made.data.metrics if "success" in name} == {"custom/success ___"}


@pytest.mark.parametrize(("make", "name"), [(WandbCallback, "wandb"), (MlflowCallback, "mlflow")])
def test_a_tool_that_is_not_installed_is_one_line(make: Any, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(millrace.UsageError) as caught:
        make()
    assert str(caught.value) == f"{name} is not installed: pip install {name}"


def test_rows_are_sent_now_and_then_and_the_last_one_always() -> None:
    now = [0.0]
    rows = RowFilter(1.0, lambda: now[0])
    requests = Requests()

    def at(updates: int) -> Progress:
        return Progress(updates=updates, metrics={"train/loss": 0.5}, requests=requests)

    requests.log("mine", 3)
    first = rows.due(at(1))
    assert first is not None
    assert (first["train/loss"], first["custom/mine"]) == (0.5, 3.0)
    assert "rollout/ep_rew_mean" not in first, "it is missing"
    now[0] = 0.9
    assert rows.due(at(2)) is None
    assert rows.last(at(2)) is not None
    assert rows.last(at(2)) is None, "once"
    now[0] = 1.0
    assert rows.due(at(3)) is not None
