"""TensorBoard's events: each number once, at its env steps; a resumed run takes back what its checkpoint does not know."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import millrace
from millrace.extras.monitoring.tensorboard import TensorBoardCallback
from millrace.learner.run_folder.callback_requests import Requests
from millrace.learner.run_folder.metrics_log import METRICS_FILE, read_rows
from millrace.learner.run_folder.progress import ENV_STEPS_KEY, Progress
from millrace.learner.run_folder.results import EvaluatedPolicy, Evaluation
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.errors import RunError

ENV = "tests.support.envs.toy:Identity-v0"
SMALL: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "lanes": 2, "envs": 2, "rollout_steps": 16, "n_epochs": 1, "net": (8,),
    "steps": 200, "eval_episodes": 2, "progress": False,
}  # fmt: skip
FOUND = Evaluation(episodes=2, return_mean=9.0, return_std=0.0, length_mean=5.0)


def scalars(folder: Path, name: str) -> list[tuple[int, float]]:
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return [(event.step, event.value) for event in events.Scalars(name)]


def at(update: int, **fields: Any) -> Progress:
    return Progress(**{"updates": update, "env_steps": 10 * update, "lags": (0,), "return_mean": 1.0, **fields})


def test_rows_a_while_apart_and_evaluations_and_the_last(tmp_path: Path) -> None:
    events = TensorBoardCallback(RunFolder(tmp_path), every_s=math.inf)
    events.on_start(Progress())
    for update in range(1, 26):
        events.on_update(at(update))
        if update == 7:
            events.on_evaluation(at(7, evaluation=FOUND, evaluated=EvaluatedPolicy(7, 70)))
    events.on_end(at(25))
    assert scalars(tmp_path, "rollout/ep_rew_mean") == [(10, 1.0), (70, 1.0), (250, 1.0)]
    assert scalars(tmp_path, "eval/mean_reward") == [(70, 9.0)]


def test_an_evaluation_beside_training_says_which_policy_it_is_of(tmp_path: Path) -> None:
    events = TensorBoardCallback(RunFolder(tmp_path))
    events.on_start(Progress())
    events.on_evaluation(at(7, evaluation=FOUND, evaluated=EvaluatedPolicy(3, 30)))
    events.on_end(at(7))
    assert scalars(tmp_path, "eval/env_steps") == [(70, 30.0)]


def test_each_number_is_written_once_and_at_once_with_its_row(tmp_path: Path) -> None:
    requests = Requests()
    events = TensorBoardCallback(RunFolder(tmp_path), every_s=0.0)
    events.on_start(Progress())
    requests.log("mine", 3)
    events.on_update(at(1, requests=requests, metrics={"train/loss": 0.5}))
    events.on_evaluation(at(1, evaluation=FOUND, metrics={"train/loss": 0.5}))
    events.on_end(at(1, metrics={"train/loss": 0.5}))
    for name, number in {"train/loss": 0.5, "custom/mine": 3.0, "eval/mean_reward": 9.0}.items():
        assert scalars(tmp_path, name) == [(10, number)], name


def test_numbers_from_before_the_first_update(tmp_path: Path) -> None:
    events = TensorBoardCallback(RunFolder(tmp_path))
    events.on_start(Progress(metrics={"clone/loss": 0.5}))
    events.on_evaluation(Progress(metrics={"clone/loss": 0.5}, evaluation=FOUND))
    events.on_end(at(1))
    assert scalars(tmp_path, "clone/loss") == [(0, 0.5)]


def test_a_resumed_run_takes_back_what_its_checkpoint_does_not_know(tmp_path: Path) -> None:
    for begins, number in ((0, 1.0), (2, 2.0)):
        events = TensorBoardCallback(RunFolder(tmp_path), every_s=0.0)
        events.on_start(at(begins, lags=()))
        for update in range(begins + 1, begins + 4):
            events.on_update(at(update, return_mean=number))
        events.on_end(at(begins + 3))
    assert scalars(tmp_path, "rollout/ep_rew_mean") == [(10, 1.0), (20, 1.0), (30, 2.0), (40, 2.0), (50, 2.0)]


def test_what_the_disk_refuses_is_written_later(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    events = TensorBoardCallback(RunFolder(tmp_path), every_s=0.0)
    events.on_start(Progress())
    assert events._file is not None
    file = events._file._file

    class Full:
        """Takes nothing."""

        def write(self, record: bytes) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        def truncate(self, length: int) -> None:
            file.truncate(length)

    events._file._file = Full()  # type: ignore[assignment]
    events.on_update(at(1))
    events.on_update(at(2))
    assert "rows are not written yet: No space left on device" in caplog.text
    assert len(caplog.messages) == 1, "said once"
    events._file._file = file
    events.on_end(at(3))
    assert [steps for steps, _ in scalars(tmp_path, "rollout/ep_rew_mean")] == [10, 20, 30]


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "outside").mkdir()
    (tmp_path / "run" / "tensorboard").symlink_to(tmp_path / "outside")
    with pytest.raises(RunError, match="expected a folder, got a link"):
        TensorBoardCallback(RunFolder(tmp_path / "run")).on_start(Progress())
    assert not list((tmp_path / "outside").iterdir())


def test_a_run_writes_the_numbers_of_its_rows(tmp_path: Path) -> None:
    class Logs(millrace.Callback):
        def on_update(self, progress: Progress) -> None:
            progress.log("mine", 2 * progress.updates)

    folder = millrace.train(ENV, run_dir=str(tmp_path), tensorboard=True, callbacks=[Logs()], **SMALL).path
    *_, last = read_rows(folder / METRICS_FILE)
    for name in ("rollout/ep_rew_mean", "custom/mine", "train/value_loss"):
        steps, value = scalars(folder, name)[-1]
        assert steps == last[ENV_STEPS_KEY]
        assert value == np.float32(last[name]), name


def test_a_run_that_is_not_asked_to_write_them_does_not(tmp_path: Path) -> None:
    folder = millrace.train(ENV, run_dir=str(tmp_path), **SMALL).path
    assert not (folder / "tensorboard").exists()
