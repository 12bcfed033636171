"""`millrace.Run`: what a run folder holds, and what can be done with its policy, from Python."""

import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.cli.main import main
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.run_format import check_format
from tests.support.in_process.collectors import TOY
from tests.system.stage.run_folders import policy_of

SMALL: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "envs": 4, "lanes": 2, "rollout_steps": 16, "n_epochs": 2, "net": (8,),
    "eval_episodes": 2, "torch_threads": 1, "preset": "none", "progress": False,
}  # fmt: skip
PLAY: dict[str, Any] = {"transport": "inproc", "workers": 1}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has ended. Do not write into it."""
    folder = tmp_path_factory.mktemp("runs")
    return millrace.train("CartPole-v1", run_dir=str(folder), steps=600, eval_every=300, **SMALL).path


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> millrace.Run:
    """A copy of that run."""
    return millrace.Run(shutil.copytree(trained, tmp_path / trained.name))


def test_a_number_of_more_than_64_bits_is_a_float() -> None:
    metrics = millrace.Metrics([{"a": 2**70, "b": -(2**63) + 1}])
    assert {name: column.dtype.name for name, column in metrics.items()} == {"a": "float64", "b": "int64"}
    assert metrics["a"].tolist() == [2.0**70]


def test_train_returns_a_run_that_is_a_path(run: millrace.Run) -> None:
    assert Path(run) == run.path == Path(os.fspath(run))
    assert json.loads(Path(run, "summary.json").read_text())["env"] == "CartPole-v1"
    assert run == millrace.Run(str(run.path)) != run.path
    assert len({run, millrace.Run(run)}) == 1


def test_its_results_are_those_of_the_folder(run: millrace.Run) -> None:
    summary = run.summary
    assert summary is not None
    written = json.loads((run.path / "summary.json").read_text())
    assert (summary.env_steps, summary.updates, summary.stop_reason) == (
        written["env_steps"], written["updates"], written["stop_reason"],
    )  # fmt: skip
    assert (run.config.env, run.config.seed, run.config.steps) == ("CartPole-v1", 1, 600)
    (run.path / "summary.json").unlink()
    assert run.summary is None


def test_metrics_are_columns_of_numbers(run: millrace.Run) -> None:
    metrics, rows = run.metrics, read_rows(run.path / "metrics.jsonl")
    steps = metrics["time/total_timesteps"]
    assert steps.dtype == np.int64
    assert steps.tolist() == [row["time/total_timesteps"] for row in rows]
    evaluations = metrics["eval/mean_reward"]
    assert evaluations.dtype == np.float64
    assert np.isfinite(evaluations).tolist() == [row.get("eval/mean_reward") is not None for row in rows]
    assert 1 <= np.isfinite(evaluations).sum() < len(rows)
    assert metrics.unreadable == 0
    assert f"metrics of {len(rows)} updates: " in repr(metrics)


def test_rows_that_cannot_be_read_are_left_out_and_counted(run: millrace.Run) -> None:
    table, whole = run.path / "metrics.jsonl", run.metrics
    lines = table.read_bytes().splitlines(keepends=True)
    lines[1] = b"rubbish\n"
    lines[2] = b'{"time/total_timesteps": null}\n'
    table.write_bytes(b"".join(lines) + b'{"time/total_tim')
    metrics = run.metrics
    assert metrics.unreadable == 2
    kept = [n for n in range(len(lines)) if n not in (1, 2)]
    assert metrics["time/iterations"].tolist() == whole["time/iterations"][kept].tolist()
    assert "2 more cannot be read" in repr(metrics)
    table.unlink()
    assert dict(run.metrics) == {}


def test_its_repr_says_how_it_went_and_never_raises(run: millrace.Run) -> None:
    summary = run.summary
    assert summary is not None
    text = repr(run)
    assert text.startswith(f"<run {run.path}: CartPole-v1, ppo, seed 1, {summary.env_steps:,} env steps in")
    assert f"greedy {summary.evaluation}" in text
    assert summary.stop_reason in run._repr_html_()
    (run.path / "summary.json").unlink()
    newest = int(run.metrics["time/total_timesteps"][-1])
    assert f"{newest:,} env steps" in repr(run)
    assert repr(run).endswith(", not finished>")
    (run.path / "metrics.jsonl").unlink()
    assert repr(run) == f"<run {run.path}: CartPole-v1, ppo, seed 1, not finished>"
    (run.path / "config.toml").write_text("[")
    assert "is not TOML" in repr(run)
    shutil.rmtree(run.path)
    assert "expected a run folder with a config.toml, got none" in repr(run)


def test_its_repr_needs_no_algorithm(run: millrace.Run) -> None:
    """Another program trained it with a class of its own."""
    config = run.path / "config.toml"
    own = config.read_text().replace('algo = "ppo"', 'algo = "__main__:Mine"').replace("[ppo]", '["__main__:Mine"]')
    config.write_text(own)
    assert repr(run).startswith(f"<run {run.path}: CartPole-v1, __main__:Mine, seed 1, ")
    assert repr(run).endswith(", all steps done>")


def test_html_shows_text_of_the_folder_as_text(run: millrace.Run) -> None:
    moved = millrace.Run(run.path.rename(run.path.with_name("<b>run")))
    assert "<b>" not in moved._repr_html_()
    assert "&lt;b&gt;run" in moved._repr_html_()


@pytest.mark.parametrize("place", ["nowhere", "."])
def test_what_is_no_run_folder_is_refused(place: str, tmp_path: Path) -> None:
    with pytest.raises(millrace.UsageError, match=r"no such folder|expected a run folder"):
        millrace.Run(tmp_path / place)


def test_evaluate_is_the_command(run: millrace.Run, capsys: pytest.CaptureFixture[str]) -> None:
    result = run.evaluate(5, seed=9, **PLAY)
    assert (
        main(["evaluate", str(run.path), "--episodes", "5", "--seed", "9", "--transport", "inproc", "--workers", "1"]) == 0
    )
    assert capsys.readouterr().out == f"{result}\n"
    assert millrace.evaluate(run.path, 5, seed=9, **PLAY) == result
    assert millrace.evaluate(str(run.path), 5, seed=10, **PLAY) != result
    assert (result.episodes, result.cut) == (5, 0)
    assert millrace.evaluate(run, 5, seed=9, max_steps=10, **PLAY).cut == 5


def test_record_is_the_command(run: millrace.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    result = run.record("cartpole/one-v0", steps=40, npy=tmp_path / "one.npy", **PLAY)
    flags = ["--steps", "40", "--npy", str(tmp_path / "two.npy"), "--transport", "inproc", "--workers", "1"]
    assert main(["record", str(run.path), "--out", "cartpole/two-v0", *flags]) == 0
    assert capsys.readouterr().out.splitlines()[0] == str(result).replace("one-v0", "two-v0")
    assert (tmp_path / "one.npy").read_bytes() == (tmp_path / "two.npy").read_bytes()
    assert result.steps >= 40


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"episode": 5}, "evaluate: unknown keyword episode; did you mean episodes?"),
        ({"workers": "two"}, "^evaluate: workers: expected int or \"none\", got 'two'$"),
        ({"episodes": 2.5}, "^evaluate: episodes: expected int or None, got 2.5$"),
        ({"episodes": 0}, "episodes: expected int >= 1, got 0"),
        ({"transport": "udp"}, "^evaluate: transport: expected one of inproc, ipc, tcp, got 'udp'$"),
    ],
)
def test_a_wrong_keyword_is_refused_in_one_line(keywords: dict[str, Any], message: str, run: millrace.Run) -> None:
    with pytest.raises(millrace.UsageError, match=message):
        millrace.evaluate(run, **keywords)


def test_the_file_of_rows_may_be_named_by_text(run: millrace.Run) -> None:
    with pytest.raises(millrace.UsageError, match=r"^no/rows.npy cannot be written: no such folder no$"):
        run.record("cartpole/rows-v0", steps=10, workers=1, npy="no/rows.npy")
    with pytest.raises(millrace.UsageError, match=r"^record: npy: expected text or a path, got 5$"):
        run.record("cartpole/rows-v0", steps=10, workers=1, npy=5)  # type: ignore[arg-type]


def test_resume_continues_the_same_run(run: millrace.Run) -> None:
    before = run.summary
    again = run.resume(steps=900, progress=False)
    assert again == run
    assert before is not None
    assert run.summary is not None
    assert before.env_steps < run.summary.env_steps <= 900


class Pole(gymnasium.Wrapper[Any, Any, Any, Any]):
    """CartPole, made by a callable without an id."""


def pole() -> gymnasium.Env[Any, Any]:
    return Pole(gymnasium.make("CartPole-v1"))


def test_what_was_given_as_an_object_is_given_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = millrace.train(pole, run_dir=str(tmp_path), steps=300, **SMALL)
    assert run.evaluate(2, **PLAY).episodes == 2
    resumed = run.resume(steps=600, progress=False).summary
    assert resumed is not None
    assert resumed.env_steps > 300
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    assert run.record("pole/own-v0", steps=20, **PLAY).steps >= 20
    assert millrace.evaluate(run.path, 2, env=pole, **PLAY).episodes == 2


class Wanders(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Changes the current folder of its process, as some simulators do."""

    def reset(self, **keywords: Any) -> Any:
        os.chdir("elsewhere" if Path("elsewhere").is_dir() else ".")
        return super().reset(**keywords)


@pytest.mark.parametrize("who", ["environment", "callback"])
def test_a_run_stays_in_its_folder_whoever_changes_the_current_one(
    who: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # it is the current one again afterwards
    (tmp_path / "elsewhere").mkdir()
    given: dict[str, Any] = {"wrappers": [Wanders]} if who == "environment" else {}
    callbacks = [lambda progress: os.chdir(tmp_path / "elsewhere")] if who == "callback" else []
    run = millrace.train("CartPole-v1", run_dir="runs", steps=200, tensorboard=True, callbacks=callbacks, **given, **SMALL)
    assert Path.cwd() == tmp_path / "elsewhere"
    assert run.path.parent == tmp_path / "runs"
    files = {"policy.safetensors", "summary.json", "metrics.jsonl", "checkpoints", "tensorboard"}
    assert files <= {path.name for path in run.path.iterdir()}
    assert not [*Path.cwd().iterdir()]
    monkeypatch.chdir(tmp_path)
    assert run.resume(steps=300, callbacks=callbacks).summary is not None


@pytest.mark.parametrize("kind", ["svg", "png"])
def test_plot_is_a_picture_and_the_file_of_the_command(run: millrace.Run, tmp_path: Path, kind: str) -> None:
    picture = run.plot(tmp_path / f"python.{kind}")
    assert main(["plot", str(run.path), "--out", str(tmp_path / f"command.{kind}")]) == 0
    content = (tmp_path / f"python.{kind}").read_bytes()
    assert content == (tmp_path / f"command.{kind}").read_bytes()
    assert content == (picture._repr_svg_().encode() if kind == "svg" else picture.png())
    assert ">CartPole-v1</text>" in picture.svg


class Silent(millrace.Callback):
    """Does nothing."""


def test_a_resume_without_the_callbacks_that_a_program_passed_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = millrace.train("CartPole-v1", run_dir=str(tmp_path), steps=128, callbacks=[Silent()], **SMALL)
    run.resume(steps=192, callbacks=[Silent()], progress=False)
    assert "callbacks" not in caplog.text
    run.resume(steps=256, progress=False)
    assert "the run continues without the callbacks that a Python program passed to it (Silent): only that" in caplog.text
    caplog.clear()
    run.resume(steps=320, progress=False)
    assert "callbacks" not in caplog.text, "they were left out before"


def test_the_caller_s_process_runs_no_environment_code(tmp_path: Path) -> None:
    """An environment that ends its process at the first step."""
    run = millrace.train(f"{TOY}Countdown-v0", run_dir=str(tmp_path), steps=64, **SMALL)
    with pytest.raises(millrace.RunError):
        run.evaluate(1, env=dies, workers=1)


def dies() -> gymnasium.Env[Any, Any]:
    os._exit(3)


def test_a_run_from_another_takes_it_once_and_gives_the_same_bits_for_any_number_of_workers(
    run: millrace.Run, tmp_path: Path
) -> None:
    """A resumed run does not read the other folder again: whether that is there or gone, it continues the same."""
    more: dict[str, Any] = {"start_from": run, "run_dir": tmp_path / "new", "seed": 2, "steps": 128}
    one, two = (millrace.train("CartPole-v1", **more, **SMALL | {"workers": workers}) for workers in (1, 2))
    assert policy_of(one.path) == policy_of(two.path)
    assert (one.config.start_from, one.config.from_parts) == (str(run.path), "auto")
    one.resume(steps=192, progress=False)
    taken = rf"starts from {re.escape(str(run.path))} \(CartPole-v1\): policy, statistics, after \d+ env steps"
    assert re.fullmatch(taken, check_format(one.path).started_from), "a resumed run keeps it"
    shutil.rmtree(run.path)
    two.resume(steps=192, workers=1, progress=False)
    assert policy_of(one.path) == policy_of(two.path)
