"""However a run ends, a checkpoint of the last whole update exists, and one line says where. Runs in this process."""

from __future__ import annotations

import errno
import logging
import math
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import millrace
from millrace.launch.training import train
from millrace.learner.algorithms.minibatches import LossInput
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.callbacks.callbacks import Callbacks
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder import atomic_write, checkpoint
from millrace.learner.run_folder.last_line import resume_command
from millrace.learner.run_folder.metrics_log import METRICS_FILE, read_rows
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.run_format import write_format
from millrace.protocol.errors import RunError, UsageError
from tests.support.envs.toy import Identity
from tests.system.stage.run_folders import folder_of, policy_of, saved, summary
from tests.system.stage.runs import accounted

SMALL: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "lanes": 2, "envs": 2, "rollout_steps": 16, "n_epochs": 2, "batch_size": 16,
    "net": (8,), "steps": 400, "eval_episodes": 2, "checkpoint_every_s": 1000.0,
}  # fmt: skip
Watch = Callable[[Progress], None] | Callbacks


class UsersError(Exception):
    """What the user's code raises."""


def run(tmp_path: Path, watch: Watch = lambda progress: None, resume: Path | None = None, **settings: Any) -> Path:
    return train(
        resolve("tests.support.envs.toy:Identity-v0", run_dir=str(tmp_path / "runs"), **{**SMALL, **settings}), resume, watch
    )


def raises_at(update: int, error: BaseException) -> Watch:
    def watch(progress: Progress) -> None:
        if progress.updates == update:
            raise error

    return watch


def how_to_go_on(folder: Path) -> list[str]:
    env_steps = checkpoint.newest(folder)[0].env_steps
    return [f"{env_steps:,} env steps are saved; continue with: {resume_command(folder)}"]


def parameters(folder: Path) -> torch.Tensor:
    found: torch.Tensor = checkpoint.newest(folder)[0].state["algorithm"]["parameters"]
    return found


@pytest.mark.parametrize("max_lag", [0, 1])
@pytest.mark.parametrize(
    "error", [UsersError("no\nmore"), KeyboardInterrupt(), SystemExit(3)], ids=lambda e: type(e).__name__
)
def test_a_watch_that_raises(tmp_path: Path, error: BaseException, max_lag: int) -> None:
    with pytest.raises(type(error)) as caught:
        run(tmp_path, raises_at(5, error), max_lag=max_lag)
    folder = folder_of(tmp_path / "runs")
    assert caught.value is error
    assert error.__notes__ == ["raised in watch", *how_to_go_on(folder)]
    assert saved(folder) == 5
    told = summary(folder)
    assert told["stop_reason"] in ("UsersError: no", "interrupted", "SystemExit: 3")
    accounted(told, lanes=2, rows=16, max_lag=max_lag)
    del error.__notes__


def test_a_run_whose_environment_only_the_script_has_goes_on_in_python(tmp_path: Path) -> None:
    settings: dict[str, Any] = {**SMALL, "run_dir": str(tmp_path / "runs"), "progress": False}
    with pytest.raises(UsersError) as caught:
        millrace.train(lambda: Identity(), callbacks=[raises_at(2, UsersError())], **settings)
    folder = str(folder_of(tmp_path / "runs"))
    assert caught.value.__notes__[-1].endswith(f"; continue in Python with: millrace.train(ENV, resume={folder!r})")


def test_the_command_that_goes_on_is_of_the_same_kind_and_may_be_pasted_into_a_shell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    here, elsewhere = Path("my run"), Path("mine")
    for run in (here, elsewhere):
        run.mkdir()
        write_format(run, workers_elsewhere=run == elsewhere)
    assert resume_command(here) == "millrace train --resume 'my run'"
    assert resume_command(elsewhere) == "millrace learner --resume mine"
    assert resume_command(Path("gone")) == "millrace train --resume gone"
    assert resume_command(Path("-gone")) == "millrace train --resume ./-gone"


def test_a_watch_that_raises_in_an_evaluation(tmp_path: Path) -> None:
    def watch(progress: Progress) -> None:
        if progress.waiting.startswith("evaluating"):
            raise UsersError

    with pytest.raises(UsersError):
        run(tmp_path, watch, eval_every=100, eval_episodes=200)
    found = checkpoint.newest(folder_of(tmp_path / "runs"))[0]
    assert saved(folder_of(tmp_path / "runs")) == 4
    assert found.state["past"]["state"]["next_evaluation"] == 100 <= found.env_steps, "it must be made again"


def test_a_watch_that_raises_at_the_very_end(tmp_path: Path) -> None:
    def watch(progress: Progress) -> None:
        finished = (folder_of(tmp_path / "runs") / "summary.json").exists()
        if finished and not progress.waiting.startswith("evaluating"):
            raise UsersError

    with pytest.raises(UsersError):
        run(tmp_path, watch)
    assert summary(folder_of(tmp_path / "runs"))["stop_reason"] == "all steps done"


def breaks(monkeypatch: pytest.MonkeyPatch, update: int, minibatch: int, how: Callable[[dict[str, Any]], None]) -> None:
    """Have `how` act on the numbers that the loss of this minibatch of this update logs."""
    loss, done = PPO.loss, [0]

    def broken(self: PPO, rows: LossInput) -> Any:
        found, numbers = loss(self, rows)
        logged = dict(numbers)
        if self.version == update:
            done[0] += 1
            if done[0] == minibatch:
                how(logged)
        return found, logged

    monkeypatch.setattr(PPO, "loss", broken)


@pytest.mark.parametrize("how", ["loss", "user code", "Ctrl-C"])
def test_an_update_that_fails_in_the_middle_is_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    with pytest.raises(UsersError):
        run(tmp_path / "whole", raises_at(3, UsersError()), seed=4)

    def act(metrics: dict[str, Any]) -> None:
        match how:
            case "loss":
                metrics["value_loss"] = float("nan")
            case "user code":
                raise UsersError("in the loss")
            case _:
                raise KeyboardInterrupt

    breaks(monkeypatch, 3, 3, act)
    expected = {"loss": RunError, "user code": UsersError, "Ctrl-C": KeyboardInterrupt}[how]
    with pytest.raises(expected) as caught:
        run(tmp_path / "broken", seed=4)
    monkeypatch.undo()
    whole, broken = (folder_of(tmp_path / part / "runs") for part in ("whole", "broken"))
    assert saved(broken) == saved(whole) == 3
    assert torch.equal(parameters(whole), parameters(broken)), "a half update was saved"
    assert policy_of(whole) == policy_of(broken)
    assert caught.value.__notes__ == how_to_go_on(broken)
    accounted(summary(broken), lanes=2, rows=16)
    assert summary(broken)["ledger"]["outstanding"] == 2, "the rollouts of the update that failed"
    resumed = run(tmp_path / "broken", resume=broken, seed=4)
    accounted(summary(resumed), lanes=2, rows=16)
    assert summary(resumed)["stop_reason"] == "all steps done"


@pytest.mark.parametrize("parameter", [0, -1], ids=["acting", "critic"])
def test_weights_that_are_not_finite_are_never_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parameter: int
) -> None:
    update = PPO.update

    def broken(self: PPO, batch: Any, pulse: Any) -> dict[str, float]:
        metrics = update(self, batch, pulse)
        if self.version == 3:
            self.net.flat[parameter] = float("inf")
        return metrics

    monkeypatch.setattr(PPO, "update", broken)
    with pytest.raises(RunError, match="update 2: the weights are not finite"):
        run(tmp_path)
    assert saved(folder_of(tmp_path / "runs")) == 2
    assert torch.isfinite(parameters(folder_of(tmp_path / "runs"))).all()


def test_a_run_that_is_killed_early_resumes_from_its_first_update_and_says_what_is_lost(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def watch(progress: Progress) -> None:
        if progress.updates == 4 and not progress.waiting.startswith("evaluating"):
            shutil.copytree(progress.run, tmp_path / "killed")  # what a killed process leaves

    run(tmp_path, watch)
    assert run(tmp_path, resume=tmp_path / "killed") == tmp_path / "killed"
    rows = read_rows(tmp_path / "killed" / "metrics.jsonl")
    where = f"run {tmp_path / 'killed'} continues at {rows[0]['time/total_timesteps']} env steps, after update 1"
    assert f"{where}; 3 later updates were not saved, and must be made again" in caplog.messages
    assert [row["time/iterations"] for row in rows] == list(range(1, saved(tmp_path / "killed") + 1))


@pytest.mark.parametrize("how", ["deleted", "renamed"])
def test_a_run_whose_folder_is_gone_continues_in_a_new_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    """Everything that is written from then on is in one folder, at the path of the run."""
    caplog.set_level(logging.WARNING, "millrace")
    elsewhere = tmp_path / "elsewhere"

    def watch(progress: Progress) -> None:
        if progress.updates == 3 and not progress.waiting.startswith("evaluating"):
            Path(progress.run).rename(elsewhere)
            if how == "deleted":
                shutil.rmtree(elsewhere)
        if progress.updates == 6:
            shutil.copytree(progress.run, tmp_path / "killed", dirs_exist_ok=True)

    folder = run(tmp_path, watch)
    said = [record.getMessage() for record in caplog.records if "run folder" in record.getMessage()]
    line = "was deleted or renamed; the run continues there in a new folder"
    assert said == [f"run folder {folder} {line}"]
    assert summary(folder)["stop_reason"] == "all steps done"
    rows = read_rows(folder / "metrics.jsonl")
    assert [row["time/iterations"] for row in rows] == list(range(4, saved(folder) + 1)), "rows after it are missing"
    assert saved(tmp_path / "killed") == 4, "the new folder had no checkpoint at once"
    if how == "renamed":
        assert [row["time/iterations"] for row in read_rows(elsewhere / "metrics.jsonl")] == [1, 2, 3]
        assert saved(elsewhere) == 1
    before = saved(folder)
    assert run(tmp_path, resume=folder, steps=600) == folder
    assert saved(folder) > before


def test_a_run_folder_that_is_made_again_has_the_best_policy(tmp_path: Path) -> None:
    made_again = list[bool]()

    def watch(progress: Progress) -> None:
        match progress.updates:
            case 10:  # after the one evaluation before the end
                shutil.rmtree(progress.run)
            case 11:
                made_again.append((Path(progress.run) / "best.safetensors").is_file())

    folder = run(tmp_path, watch, eval_every=256)
    assert made_again == [True]
    assert read_rows(folder / "metrics.jsonl")[0]["time/iterations"] > 8, "the rows of that evaluation are gone"
    assert summary(folder)["best"]["chosen_by"] == 10.0


@pytest.mark.parametrize(
    "what", ["checkpoints", "metrics.jsonl", "tensorboard", "policy.safetensors", "summary.json", "all"]
)
def test_a_part_of_the_folder_that_cannot_be_written_costs_warnings_and_then_the_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """What is deleted stands in the way as something else: a file where a folder was, or a folder where a file was."""
    caplog.set_level(logging.WARNING, "millrace")

    def watch(progress: Progress) -> None:
        if progress.updates == 3 and not progress.waiting.startswith("evaluating") and not (tmp_path / "done").exists():
            (tmp_path / "done").touch()
            folder = Path(progress.run)
            if what == "all":
                shutil.rmtree(folder)
                folder.write_text("not a folder")
            elif (folder / what).is_dir():
                shutil.rmtree(folder / what)
                (folder / what).write_text("not a folder")
            else:
                (folder / what).unlink(missing_ok=True)
                (folder / what).mkdir()

    monkeypatch.setattr(atomic_write, "TRY_FOR_S", 0.0)
    with pytest.raises(RunError) as caught:
        run(tmp_path, watch, checkpoint_every_s=0.0, tensorboard=True)
    (folder,) = (tmp_path / "runs").iterdir()
    said = [record.getMessage() for record in caplog.records]
    assert all("\n" not in line for line in (*said, str(caught.value)))
    assert len(said) < 24, f"said too often: {said}"
    expected = f"run folder {folder} is gone, and cannot be made again: " if what == "all" else str(folder / what)
    assert expected in str(caught.value)
    if what not in ("summary.json", "all"):
        assert summary(folder)["cut_short"], "it would count as finished"


class FullDisk:
    """A disk that is full from one update on, or until it has refused so many files."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, from_update: int, refuses: float = math.inf) -> None:
        self._full, self._from_update, self._refuses, self._fsync = False, from_update, refuses, os.fsync
        monkeypatch.setattr("millrace.learner.run_folder.atomic_write.os.fsync", self._flush)

    def watch(self, progress: Progress) -> None:
        self._full = self._full or progress.updates >= self._from_update

    def _flush(self, number: int) -> None:
        if self._full and self._refuses > 0:
            self._refuses -= 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._fsync(number)


def test_the_rows_up_to_a_checkpoint_are_on_the_disk_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A power failure could leave the checkpoint without these rows, and a resumed run doesn't write them again."""
    fsync = os.fsync
    on_disk = b""
    saves = 0

    def flush(number: int) -> None:
        nonlocal on_disk, saves
        fsync(number)
        path = Path(os.readlink(f"/proc/self/fd/{number}"))
        if path.name == METRICS_FILE:
            on_disk = path.read_bytes()
        elif path.parent.name == "checkpoints" and path.suffix == ".tmp":
            assert on_disk == (path.parents[1] / METRICS_FILE).read_bytes()
            saves += 1

    monkeypatch.setattr(os, "fsync", flush)
    folder = run(tmp_path, checkpoint_every_s=0.0, eval_every=130)
    assert saves > summary(folder)["updates"]


def test_rows_that_are_not_on_the_disk_are_flushed_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fsync = os.fsync
    refused = 0

    def flush(number: int) -> None:
        nonlocal refused
        if os.readlink(f"/proc/self/fd/{number}").endswith(METRICS_FILE) and refused < 4:
            refused += 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(number)

    monkeypatch.setattr(os, "fsync", flush)
    folder = run(tmp_path, checkpoint_every_s=0.0)
    assert "metrics.jsonl: rows may not be on the disk: No space left on device" in caplog.text
    assert saved(folder) == summary(folder)["updates"]


def test_a_disk_that_is_full_at_the_end_fails_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atomic_write, "TRY_FOR_S", 0.0)
    with monkeypatch.context() as then, pytest.raises(RunError) as caught:
        run(tmp_path, FullDisk(then, 3).watch)
    folder = folder_of(tmp_path / "runs")
    steps = read_rows(folder / "metrics.jsonl")[-1]["time/total_timesteps"]
    path = folder / "checkpoints" / f"{steps:012d}.pt"
    full = "No space left on device"
    rows = f"{folder / METRICS_FILE}: rows may not be on the disk: {full}"
    assert str(caught.value) == f"{rows}; checkpoint {path} not written: {full}; older checkpoints are untouched"
    assert saved(folder) == 1
    assert caught.value.__notes__ == how_to_go_on(folder)
    assert not (folder / "summary.json").exists()
    resumed = run(tmp_path, resume=folder)
    assert summary(resumed)["stop_reason"] == "all steps done"
    assert saved(resumed) == len(read_rows(folder / "metrics.jsonl"))


def test_the_last_save_waits_for_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atomic_write, "TRY_EVERY_S", 0.0)
    told: list[str] = []

    class Uploads:
        def on_checkpoint(self, progress: Progress) -> None:
            told.append(progress.checkpoint)

    disk = FullDisk(monkeypatch, 3, refuses=9)
    folder = run(tmp_path, Callbacks([disk.watch, Uploads()]))
    assert summary(folder)["stop_reason"] == "all steps done"
    assert saved(folder) == summary(folder)["updates"]
    assert told[-1] == str(checkpoint.newest(folder)[0].path)


@pytest.mark.parametrize("how", ["SIGTERM", "user code"])
def test_a_run_that_is_cut_short_while_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    """An interrupt would say that the run is saved. An error that says what went wrong stays the error of the run."""
    monkeypatch.setattr(atomic_write, "TRY_FOR_S", 1000.0 if how == "SIGTERM" else 0.0)  # the grace time is shorter
    error = UsersError("in a callback")

    def watch(progress: Progress) -> None:
        disk.watch(progress)
        if progress.updates == 5:
            if how != "SIGTERM":
                raise error
            signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as then:
        disk = FullDisk(then, 3)
        with pytest.raises(RunError if how == "SIGTERM" else UsersError) as caught:
            run(tmp_path, watch, grace_s=0.5)
    if how == "SIGTERM":
        assert "not written: No space left on device" in str(caught.value)
    assert saved(folder_of(tmp_path / "runs")) == 1
    notes = caught.value.__notes__
    assert notes == ["raised in watch"] * (how != "SIGTERM") + how_to_go_on(folder_of(tmp_path / "runs"))


NAMES = ["[red]x[/red]", "with space", "öäü ✓ 学", "%s{0}", "a'b\"c", "-dash", "[0-9]*?"]


@pytest.mark.parametrize("name", NAMES)
def test_run_folders_of_any_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsersError):
        run(tmp_path / name, raises_at(2, UsersError()))
    folder = folder_of(tmp_path / name / "runs")
    assert saved(folder) == 2
    assert run(tmp_path / name, resume=folder) == folder
    assert summary(folder)["stop_reason"] == "all steps done"


def test_a_name_that_is_not_utf8_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="expected a name in UTF-8; choose another --run-dir"):
        run(tmp_path / os.fsdecode(b"\xff"))
    assert not (tmp_path / os.fsdecode(b"\xff")).exists()
