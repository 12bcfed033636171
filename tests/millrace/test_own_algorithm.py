"""examples/own_loss.py: a run of it trains, is resumed, evaluated and reported, by name and by class."""

from __future__ import annotations

import os
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

import millrace
from examples.own_loss import ClippedPlus, Conservative
from millrace.cli.main import main
from millrace.learner.algorithms import algorithm_class
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.errors import UsageError
from millrace.testing import check_algorithm

NAME = "examples.own_loss:ClippedPlus"
SMALL: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "envs": 4, "lanes": 2, "rollout_steps": 16, "n_epochs": 2, "net": (8,),
    "eval_episodes": 2, "torch_threads": 1, "preset": "none",
}  # fmt: skip


def trained(tmp_path: Path, **settings: Any) -> Path:
    return millrace.train("CartPole-v1", run_dir=str(tmp_path), **{**SMALL, "steps": 600, **settings}).path


def policy(run: Path) -> dict[str, Any]:
    return load_file(run / "policy.safetensors")


def same_policy(left: Path, right: Path) -> bool:
    one, other = policy(left), policy(right)
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def env_steps(run: Path) -> int:
    summary = RunFolder(run).summary()
    assert summary is not None
    return summary.env_steps


def test_the_examples_are_short_and_right() -> None:
    assert len(Path(sys.modules["examples.own_loss"].__file__ or "").read_text().splitlines()) <= 55
    check_algorithm(ClippedPlus, net=(16,), learning_rate=3e-3, n_epochs=2)
    check_algorithm(Conservative, net=(16,), rollout_steps=8, learning_rate=3e-3, updates_per_step=0.1)


def test_a_run_by_class_is_the_run_by_name_and_can_be_resumed(tmp_path: Path) -> None:
    by_class, by_name = trained(tmp_path / "a", algo=ClippedPlus), trained(tmp_path / "b", algo=NAME)
    assert same_policy(by_class, by_name)
    assert tomllib.loads((by_class / "config.toml").read_text())[NAME]["penalty"] == 0.1
    assert by_class.name.startswith("CartPole-v1-examples.own_loss-ClippedPlus-s1-")
    assert not same_policy(by_class, trained(tmp_path / "c", algo=NAME, penalty=50.0)), "its settings have an effect"

    before, copied = env_steps(by_class), tmp_path / "copy"
    shutil.copytree(by_class, copied)
    assert millrace.train(resume=by_class, steps=1200).path == by_class
    assert env_steps(by_class) > before
    millrace.train(resume=copied, steps=1200, algo=ClippedPlus)
    assert same_policy(by_class, copied), "what is resumed twice goes on twice with the same bits"


def test_what_looks_at_a_run_does_not_need_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = Path(sys.modules["examples.own_loss"].__file__ or "").read_text()
    (tmp_path / "my_own_loss.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    run = trained(tmp_path / "runs", algo="my_own_loss:ClippedPlus")
    (tmp_path / "my_own_loss.py").unlink()
    monkeypatch.delitem(sys.modules, "my_own_loss")
    looks = ["--episodes", "2", "--workers", "1", "--transport", "inproc"]
    assert main(["evaluate", str(run), *looks]) == 0
    assert main(["plot", str(run)]) == 0
    assert main(["report", str(run)]) == 0
    assert "ClippedPlus" in (run / "report.html").read_text()
    capsys.readouterr()
    assert main(["train", "--resume", str(run), "--steps", "1200"]) == 2
    missing = "no module named my_own_loss; is it installed, or its folder on PYTHONPATH?"
    assert capsys.readouterr().err == f"millrace: {run / 'config.toml'}: algo my_own_loss:ClippedPlus: {missing}\n"


def test_a_class_of_a_notebook_is_given_again_to_resume(tmp_path: Path) -> None:
    class Mine(ClippedPlus):
        """Made in a function, as if in a notebook."""

    run = trained(tmp_path, algo=Mine)
    name = tomllib.loads((run / "config.toml").read_text())["algo"]
    assert algorithm_class(name) is Mine
    assert millrace.train(resume=run, algo=Mine, steps=1200).path == run


def test_the_help_shows_its_settings(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "--algo", NAME, "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "--penalty FLOAT Weight of the mean squared log-ratio of new to old action probability. (default: 0.1)" in text
    assert os.getcwd() in sys.path


@pytest.mark.parametrize("files", [("config.toml", "run.json"), ("policy.json", "best.safetensors")])
@pytest.mark.parametrize("inside", ["", "videos"])
def test_the_current_folder_is_no_place_of_modules_if_it_is_in_a_run_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: tuple[str, ...], inside: str
) -> None:
    for name in files:
        (tmp_path / name).touch()
    (tmp_path / "videos").mkdir()
    monkeypatch.chdir(tmp_path / inside)
    monkeypatch.setattr(sys, "path", ["", str(tmp_path / inside), *sys.path])
    main(["--version"])
    assert not {"", str(tmp_path / inside)} & {*sys.path}


@pytest.mark.parametrize("files", [("config.toml",), ("policy.json",), ("run.json", "policy.json")])
def test_a_folder_with_some_files_of_such_names_is_the_user_s_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: tuple[str, ...]
) -> None:
    for name in files:
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    main(["--version"])
    assert str(tmp_path) in sys.path


def test_the_current_folder_comes_after_installed_modules_and_before_the_clone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    clone = str(Path(millrace.__file__).parents[1])
    monkeypatch.setattr(sys, "path", ["site-packages", clone, "others"])
    main(["--version"])
    assert sys.path == ["site-packages", str(tmp_path), clone, "others"]


def test_the_current_folder_is_last_if_millrace_is_installed_from_a_wheel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("millrace.cli.main.INSTALLED_IN", tmp_path / "site-packages")
    monkeypatch.setattr(sys, "path", [str(tmp_path / "site-packages"), "others"])
    main(["--version"])
    assert sys.path == [str(tmp_path / "site-packages"), "others", str(tmp_path)]


def test_an_error_in_its_code_names_the_place_and_keeps_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my_broken_loss.py").write_text(
        "import torch\nfrom examples.own_loss import ClippedPlus\n\n\n"
        "class Broken(ClippedPlus):\n    def loss(self, rows):\n        torch.zeros(2) + torch.zeros(2 + self.version)\n"
        "        return super().loss(rows)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    words = ["--transport", "inproc", "--workers", "1", "--rollout-steps", "16", "--run-dir", str(tmp_path / "runs")]
    assert main(["train", "CartPole-v1", "--algo", "my_broken_loss:Broken", *words]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("millrace: my_broken_loss.py:7: RuntimeError: The size of tensor a (2) must match"), said
    assert "--resume" in said
    assert said.endswith("--debug shows the traceback")


class ScalarsOfLibraries(ClippedPlus):
    def update(self, batch: Any, pulse: Any) -> Any:
        return super().update(batch, pulse) | {"one": np.float32(0.5), "two": torch.tensor(0.25), "three": 3}


class LogsNowAndThen(ClippedPlus):
    steps = 0

    def loss(self, rows: Any) -> Any:
        loss, numbers = super().loss(rows)
        self.steps += 1
        return loss, {**numbers, **({"odd": 7.0} if self.steps % 2 else {})}


def test_metrics_may_be_scalars_of_numpy_and_torch_and_may_be_missing_in_some_steps(tmp_path: Path) -> None:
    rows = read_rows(trained(tmp_path / "a", algo=ScalarsOfLibraries) / "metrics.jsonl")
    assert [(row["train/one"], row["train/two"], row["train/three"]) for row in rows] == [(0.5, 0.25, 3)] * len(rows)
    assert rows
    rows = read_rows(trained(tmp_path / "b", algo=LogsNowAndThen, batch_size=16) / "metrics.jsonl")
    assert [row["train/odd"] for row in rows] == [7.0] * len(rows), "the mean over the steps that logged it"


class LogsText(ClippedPlus):
    def loss(self, rows: Any) -> Any:
        loss, numbers = super().loss(rows)
        return loss, {**numbers, "odd": "x"}


class LogsRows(ClippedPlus):
    def loss(self, rows: Any) -> Any:
        loss, numbers = super().loss(rows)
        return loss, {**numbers, "odd": torch.zeros(3)}


class ReturnsRows(ClippedPlus):
    def loss(self, rows: Any) -> Any:
        return rows.value, {}


class ReturnsText(ClippedPlus):
    def update(self, batch: Any, pulse: Any) -> Any:
        return super().update(batch, pulse) | {"train/odd": "x"}


class ReturnsNothing(ClippedPlus):
    def update(self, batch: Any, pulse: Any) -> Any:
        super().update(batch, pulse)


class TooFewWeights(ClippedPlus):
    def weights(self) -> Any:
        parameters, buffers = super().weights()
        return parameters[:-1], buffers


class DoublesAfterAnUpdate(ClippedPlus):
    def weights(self) -> Any:
        parameters, buffers = super().weights()
        return (parameters.astype(np.float64) if self.version else parameters), buffers


class SavesAnArray(ClippedPlus):
    def state_dict(self) -> Any:
        return super().state_dict() | {"odd": np.zeros(2)}


@pytest.mark.parametrize(
    ("algorithm", "says"),
    [
        (LogsText, "LogsText.loss: odd: expected one number to log, got str"),
        (LogsRows, "LogsRows.loss: odd: expected one number to log, got Tensor [3]; log its mean"),
        (ReturnsRows, "ReturnsRows.loss: expected a 0-dimensional tensor that depends on"),
        (ReturnsText, "ReturnsText.update: metrics: expected a name and a number, got str for 'train/odd'"),
        (ReturnsNothing, "ReturnsNothing.update: expected a dict of metrics, got NoneType"),
        (TooFewWeights, "TooFewWeights.weights: parameters: expected float32[58], got float32[57]"),
        (DoublesAfterAnUpdate, "DoublesAfterAnUpdate.weights: parameters: expected float32[58], got float64[58]"),
        (SavesAnArray, "state['algorithm']['odd'] (numpy.ndarray): expected tensors and plain data, got"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_what_an_algorithm_returns_wrongly_is_said_in_one_line(tmp_path: Path, algorithm: type, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        trained(tmp_path, algo=algorithm)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
