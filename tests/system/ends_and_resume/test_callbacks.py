"""Callbacks in runs: what they are told; an early stop, a raise, Ctrl-C: a resumed run repeats nothing."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import millrace
from millrace import Callback, Progress
from millrace.learner.callbacks.callbacks import MOMENTS
from millrace.learner.rollouts.evaluation_dealer import PlayedEpisode
from millrace.learner.rollouts.hub import Hub
from millrace.learner.run_folder.atomic_write import write_atomically
from millrace.learner.run_folder.lease import Owner
from millrace.learner.run_folder.metrics_log import METRICS_FILE, read_rows
from millrace.learner.run_folder.run_folder import Interrupted
from millrace.learner.run_folder.run_lock import LOCK_FILE
from millrace.protocol.errors import RunTakenOver
from tests.system.stage.run_folders import folder_of, policy_of, saved, summary
from tests.system.stage.runs import accounted

ENV = "tests.support.envs.toy:Identity-v0"
ROWS = 16  # of a lane in a rollout
SMALL: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "lanes": 2, "envs": 2, "rollout_steps": ROWS, "n_epochs": 2, "batch_size": 16,
    "net": (8,), "steps": 400, "eval_episodes": 2, "checkpoint_every_s": 1000.0,
}  # fmt: skip


SPIN_S = 0.05
UPDATES = 13  # of 400 env steps; the rows that reset a copy do not count
EVALUATED = (5, 9)  # updates, with eval_every 130
OTHER = Owner(host="far", pid=77, boot_id="another kernel", token="theirs").encoded()  # run.lock of another process
Act = Callable[[Progress], object]


class UsersError(Exception):
    """What the user's code raises."""


class Acts(Callback):
    """Acts at one moment, and keeps what it was told: (moment, number of updates)."""

    def __init__(self, moment: str = "", act: Act = lambda progress: None, updates: int = 3) -> None:
        self.told: list[tuple[str, int]] = []
        self.facts: list[Progress] = []
        for each in MOMENTS:
            setattr(self, each, self._method(each, act if each == moment else None, updates))

    def _method(self, moment: str, act: Act | None, updates: int) -> Act:
        def method(progress: Progress) -> object:
            self.told.append((moment, progress.updates))
            self.facts.append(progress)
            late = moment in ("on_start", "on_end")
            return act(progress) if act is not None and (late or progress.updates >= updates) else None

        return method

    def of(self, moment: str) -> list[Progress]:
        return [facts for (each, _), facts in zip(self.told, self.facts, strict=True) if each == moment]


def spins(progress: Progress) -> None:
    """Takes 50 ms."""
    until_s = time.monotonic() + SPIN_S
    while time.monotonic() < until_s:
        pass


def test_the_time_of_on_rollouts_is_not_that_of_updates(tmp_path: Path) -> None:
    folder = run(tmp_path, Acts("on_rollouts", spins, updates=0))
    stages = summary(folder)["stages"]
    assert stages["learner_other"] >= UPDATES * SPIN_S


def run(tmp_path: Path, *callbacks: object, resume: Path | None = None, **settings: Any) -> Path:
    return Path(millrace.train(
        "" if resume else ENV, run_dir=str(tmp_path / "runs"), resume=resume, callbacks=callbacks, **{**SMALL, **settings}
    ))  # fmt: skip


def rows(folder: Path) -> list[int]:
    return [int(row["time/iterations"]) for row in read_rows(folder / "metrics.jsonl")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without callbacks."""
    return run(tmp_path_factory.mktemp("whole"), eval_every=130)


def test_what_callbacks_are_told(tmp_path: Path, whole: Path) -> None:
    told = Acts()
    folder = run(tmp_path, told, eval_every=130)
    assert policy_of(folder) == policy_of(whole), "callbacks that only look change nothing"
    only = [(moment, n) for moment, n in told.told if moment != "on_checkpoint"]
    expected: list[tuple[str, int]] = [("on_start", 0)]
    for n in range(UPDATES):
        expected += [("on_rollouts", n), ("on_update", n + 1)]
        expected += [("on_evaluation", n + 1)] if n + 1 in EVALUATED else []
    assert only == [*expected, ("on_evaluation", UPDATES), ("on_end", UPDATES)]
    assert ("on_checkpoint", 0) not in told.told, "one that is written before the run begins is not told"
    first, *_ = told.of("on_rollouts")
    assert [rollout.lane for rollout in first.rollouts] == [0, 1]
    assert first.rollouts[0].reward.shape == (ROWS, 1)
    with pytest.raises(ValueError, match="read-only"):
        first.rollouts[0].reward[0] = 9.0
    updated = told.of("on_update")
    assert all(facts.lags == (0, 0) and not facts.rollouts for facts in updated)
    assert updated[3].metrics.keys() >= {"train/value_loss", "train/entropy_loss"} or updated[3].metrics
    assert sum(len(facts.episodes) for facts in updated) > 10
    assert all(facts.stages["learner_update"] > 0.0 for facts in updated)
    assert updated[0].settings["steps"] == 400
    assert updated[0].settings["algorithm"]["n_epochs"] == 2
    assert updated[0].evaluation is None
    assert updated[-1].evaluation is told.of("on_evaluation")[1].evaluation is not told.of("on_evaluation")[0].evaluation
    for facts in told.of("on_checkpoint"):
        assert facts.checkpoint.endswith(f"{facts.env_steps:012d}.pt")
    assert told.of("on_end")[0].stop_reason == summary(folder)["stop_reason"] == "all steps done"


def test_numbers_that_callbacks_log_stand_in_the_row_of_the_update(tmp_path: Path) -> None:
    class Logs(Callback):
        def on_rollouts(self, progress: Progress) -> None:
            progress.log("reward", float(np.mean([rollout.reward.mean() for rollout in progress.rollouts])))

        def on_update(self, progress: Progress) -> None:
            progress.log("mine/updates", progress.updates)

        def on_evaluation(self, progress: Progress) -> None:
            progress.log("evaluated", progress.updates)

    folder = run(tmp_path, Logs(), eval_every=130)
    found = read_rows(folder / "metrics.jsonl")
    assert rows(folder) == list(range(1, UPDATES + 1))
    assert [row["mine/updates"] for row in found] == rows(folder)
    assert all(0.0 <= row["custom/reward"] <= 1.0 for row in found)
    assert [row["time/iterations"] for row in found if "eval/mean_reward" in row] == [*EVALUATED]
    assert [row.get("custom/evaluated") for row in found if "custom/evaluated" in row] == [*EVALUATED, UPDATES]


def test_numbers_that_callbacks_log_before_the_first_update_make_no_row(tmp_path: Path) -> None:
    class Stops(Callback):
        def on_rollouts(self, progress: Progress) -> bool:
            return False

        def on_evaluation(self, progress: Progress) -> None:
            progress.log("evaluated", progress.updates)

    assert rows(run(tmp_path, Stops())) == []


STOPS = [moment for moment in MOMENTS if moment != "on_end"]


@pytest.mark.parametrize("max_lag", [0, 1])
@pytest.mark.parametrize("moment", STOPS)
def test_an_early_stop(tmp_path: Path, moment: str, max_lag: int) -> None:
    """The run ends with a checkpoint, the final evaluation and a summary. Resumed without the callback it goes on."""
    stops = Acts(moment, lambda progress: False, updates=5)
    folder = run(tmp_path, stops, max_lag=max_lag, eval_every=130, checkpoint_every_s=0.0)
    at = 0 if moment == "on_start" else 5
    told = summary(folder)
    assert (told["stop_reason"], told["updates"]) == (f"ended by Acts.{moment}", at)
    assert saved(folder) == at
    assert told["evaluation"]["episodes"] == 2
    assert stops.told[-1] == ("on_end", at)
    assert rows(folder) == list(range(1, at + 1))
    accounted(told, lanes=2, rows=ROWS, max_lag=max_lag)
    assert run(tmp_path, resume=folder, max_lag=max_lag) == folder
    told = summary(folder)
    assert told["stop_reason"] == "all steps done"
    assert rows(folder) == list(range(1, UPDATES + 1))
    accounted(told, lanes=2, rows=ROWS, max_lag=max_lag)


@pytest.mark.parametrize("error", [UsersError("no\nmore"), KeyboardInterrupt()], ids=lambda e: type(e).__name__)
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_raise_in_each_method(tmp_path: Path, moment: str, error: BaseException) -> None:
    def act(progress: Progress) -> None:
        raise error

    raises = Acts(moment, act, updates=5)
    with pytest.raises(type(error)) as caught:
        run(tmp_path, raises, eval_every=130, checkpoint_every_s=0.0)
    assert caught.value is error
    notes = list(error.__notes__)
    del error.__notes__
    folder = folder_of(tmp_path / "runs")
    at = {"on_start": 0, "on_end": UPDATES}.get(moment, 5)
    assert notes[0] == f"raised in Acts.{moment}"
    if moment == "on_end":
        assert notes[1:] == [f"the run is complete: {folder}"]
    else:
        assert [note.count("env steps are saved") for note in notes[1:]] == ([1] if at else [])
    assert saved(folder) == at
    assert raises.told.count(("on_end", at)) == 1, "it hears of the end, and once"
    assert rows(folder) == list(range(1, at + 1))
    told = summary(folder)
    expected = "interrupted" if isinstance(error, KeyboardInterrupt) else "UsersError: no"
    assert told["stop_reason"] == ("all steps done" if moment == "on_end" else expected)
    accounted(told, lanes=2, rows=ROWS)
    if moment == "on_rollouts":
        assert told["ledger"]["outstanding"] == 2, "the rollouts that no update used"
    again = Acts()
    assert run(tmp_path, again, resume=folder, eval_every=130) == folder
    assert rows(folder) == list(range(1, UPDATES + 1))
    told = summary(folder)
    assert (told["stop_reason"], told["updates"]) == ("all steps done", UPDATES)
    accounted(told, lanes=2, rows=ROWS)
    if moment != "on_end":  # else nothing was left to do
        assert [n for each, n in again.told if each == "on_update"] == list(range(at + 1, UPDATES + 1)), (
            "no update is repeated"
        )


def test_an_interrupt_while_a_callback_runs(tmp_path: Path, whole: Path) -> None:
    """As the stop button of a notebook does: the callback ends, then the run. The resumed run repeats no update."""
    told = Acts("on_update", lambda progress: signal.raise_signal(signal.SIGINT), updates=4)
    with pytest.raises(Interrupted) as caught:
        run(tmp_path, told, eval_every=130)
    assert not caught.value.complete
    folder = caught.value.run
    assert saved(folder) == max(n for moment, n in told.told if moment == "on_update") == 4
    again = Acts()
    run(tmp_path, again, resume=folder)
    assert rows(folder) == list(range(1, UPDATES + 1))
    assert [n for moment, n in again.told if moment == "on_update"] == list(range(5, UPDATES + 1))
    assert again.told[0] == ("on_start", 4)
    accounted(summary(folder), lanes=2, rows=ROWS)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("moment", ["on_evaluation", "on_end"])
def test_an_interrupt_after_training_ends_the_program_and_the_run_is_complete(
    tmp_path: Path, moment: str, number: signal.Signals
) -> None:
    """A loop that trains one run after another must not begin the next run."""
    with pytest.raises(Interrupted) as caught:
        run(tmp_path, Acts(moment, lambda progress: signal.raise_signal(number), updates=UPDATES))
    assert caught.value.complete
    folder = caught.value.run
    told = summary(folder)
    assert (told["stop_reason"], told["cut_short"], told["updates"]) == ("all steps done", False, UPDATES)
    assert told["evaluation"] is not None
    again = Acts()
    assert run(tmp_path, again, resume=folder) == folder
    assert again.told == [], "nothing was left to do"


def test_a_run_that_another_process_takes_over_ends_without_a_summary(tmp_path: Path) -> None:
    told = Acts("on_update", lambda progress: Path(progress.run, LOCK_FILE).write_bytes(OTHER), updates=4)
    with pytest.raises(RunTakenOver):
        run(tmp_path, told, checkpoint_every_s=0.0)
    (end,) = told.of("on_end")
    assert (end.updates, end.cut_short) == (4, True)
    assert "process 77 on far took it over" in end.stop_reason
    assert not (folder_of(tmp_path / "runs") / "summary.json").exists()


def test_a_run_that_another_process_takes_over_writes_no_row_into_its_metrics(tmp_path: Path) -> None:
    def take_over(progress: Progress) -> None:
        Path(progress.run, LOCK_FILE).write_bytes(OTHER)
        write_atomically(Path(progress.run, METRICS_FILE), lambda file: file.write(b"theirs\n"))  # as a resume does

    with pytest.raises(RunTakenOver):
        run(tmp_path, Acts("on_rollouts", take_over, updates=4))
    assert (folder_of(tmp_path / "runs") / METRICS_FILE).read_bytes() == b"theirs\n"


def test_a_run_that_another_process_takes_over_during_an_evaluation_keeps_no_best_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played = Hub.end_evaluation

    def end_evaluation(hub: Hub, watch: Callable[[int, int], None]) -> list[PlayedEpisode]:
        episodes = played(hub, watch)
        (folder_of(tmp_path / "runs") / LOCK_FILE).write_bytes(OTHER)
        return episodes

    monkeypatch.setattr(Hub, "end_evaluation", end_evaluation)
    with pytest.raises(RunTakenOver):
        run(tmp_path, eval_every=130)
    assert not (folder_of(tmp_path / "runs") / "best.safetensors").exists()


def test_a_raise_after_an_error_is_only_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Twice(Callback):
        def on_update(self, progress: Progress) -> None:
            raise UsersError("first")

        def on_checkpoint(self, progress: Progress) -> None:
            if progress.updates:
                raise UsersError("second")

        def on_end(self, progress: Progress) -> None:
            raise UsersError("third")

    with pytest.raises(UsersError, match="first"):
        run(tmp_path, Twice())
    said = [record.getMessage() for record in caplog.records]
    assert [line for line in said if "UsersError" in line] == ["UsersError: second", "UsersError: third"]
    assert saved(folder_of(tmp_path / "runs")) == 1


def test_a_callback_by_its_name_is_called_again_when_the_run_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from millrace.cli.main import main

    (tmp_path / "mine_on_disk.py").write_text(
        "from millrace import Callback\n"
        "class Stop(Callback):\n"
        "    def on_update(self, progress):\n"
        "        return progress.updates % 4 != 0\n"
        "class Fail(Callback):\n"
        "    def on_update(self, progress):\n"
        "        raise ValueError('no\\nmore')\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in SMALL.items() if name != "net"]
    flags += [f"--run-dir={tmp_path / 'runs'}"]
    named = ["--callbacks", "mine_on_disk:Stop"]
    assert main(["train", ENV, *flags, *named]) == 0
    folder = folder_of(tmp_path / "runs")
    assert "ended by Stop.on_update" in capsys.readouterr().out
    assert summary(folder)["updates"] == 4
    assert main(["train", "--resume", str(folder), *named]) == 0
    assert summary(folder)["updates"] == 8, "the run keeps the name, and naming it again changes nothing"
    assert main(["train", "--resume", str(folder), "--callbacks", "mine_on_disk:Fail"]) == 1
    err = capsys.readouterr().err.strip().splitlines()
    assert err[-1].startswith("millrace: mine_on_disk.py:7: ValueError: no; raised in Fail.on_update; ")
    assert f"; continue with: millrace train --resume {folder}; " in err[-1]
    assert main(["train", ENV, *flags, "--callbacks", "mine_on_disk:Stp"]) == 2
    assert "module mine_on_disk has no Stp; did you mean mine_on_disk:Stop?" in capsys.readouterr().err
    assert folder_of(tmp_path / "runs") == folder, "no folder is made for a callback that does not exist"
