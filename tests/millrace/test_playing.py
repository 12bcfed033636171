"""`evaluate` and `record` keep within the limits of the run that they play, unless flags say otherwise."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import pytest

from millrace import playing
from millrace.launch.policy_workers import PlayingWorkers
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.play_flags import EvaluateFlags, RecordFlags
from millrace.protocol.errors import UsageError

Patch = pytest.MonkeyPatch
LICENCES: dict[str, Any] = {"envs": 2, "lanes": 2, "eval_copies": 1, "max_env_copies": 3}


class Started(Exception):
    """Raised where workers would start."""

    def __init__(self, workers: PlayingWorkers) -> None:
        self.workers = workers


@pytest.fixture(autouse=True)
def _no_workers(monkeypatch: Patch) -> None:
    def started(policy: object, which: PlayingWorkers, watch: object) -> NoReturn:
        raise Started(which)

    monkeypatch.setattr(playing, "policy_player", started)
    monkeypatch.setattr(playing, "policy_to_play", lambda flags, given: None)


def run_with(tmp_path: Path, **settings: Any) -> Path:
    return RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path), preset="none", **settings)).path


def evaluating(run: Path, **flags: Any) -> PlayingWorkers:
    with pytest.raises(Started) as caught:
        playing.play(EvaluateFlags(run=run, **flags), lambda line: None)
    return caught.value.workers


@pytest.mark.parametrize(
    ("settings", "flags", "expected"),
    [
        ({}, {}, (2, 4)),
        ({"eval_copies": 3}, {}, (2, 3)),
        (LICENCES, {}, (2, 1)),
        ({**LICENCES, "envs": 2, "eval_copies": 2, "max_env_copies": 4}, {}, (2, 2)),
        ({"envs": 1, "lanes": 1, "eval_copies": 2, "max_env_copies": 3}, {}, (1, 2)),
        (LICENCES, {"copies": 2}, (1, 2)),
        (LICENCES, {"copies": 2, "workers": 5}, (5, 2)),
        ({"eval_copies": 3}, {"copies": 2}, (2, 2)),
        (LICENCES, {"video": True}, (2, 1)),
    ],
)
def test_an_evaluation_keeps_within_the_copies_of_its_run(
    settings: dict[str, Any],
    flags: dict[str, Any],
    expected: tuple[int, int],
    tmp_path: Path,
    monkeypatch: Patch,
) -> None:
    monkeypatch.setattr(playing, "started_by", lambda name: lambda: None)
    started = evaluating(run_with(tmp_path, **settings), **flags)
    assert (started.workers, started.copies) == expected


def test_a_recording_keeps_within_them_too(tmp_path: Path) -> None:
    one = run_with(tmp_path, envs=1, lanes=1, eval_copies=1, max_env_copies=2)
    assert playing.playing_workers(RecordFlags(run=one, out="a/b-v0"), None, 1).workers == 2
    assert playing.playing_workers(RecordFlags(run=one, out="a/b-v0"), 7, 1).workers == 7


def test_the_timeouts_are_those_of_the_run(tmp_path: Path) -> None:
    settings = evaluating(run_with(tmp_path, start_timeout_s=900, step_timeout_s=30), max_env_failures=7).settings
    assert (settings.start_timeout_s, settings.step_timeout_s, settings.max_env_failures) == (900, 30, 7)


def test_a_folder_with_only_a_policy_has_no_limits(tmp_path: Path) -> None:
    started = evaluating(tmp_path)
    assert (started.workers, started.copies, started.settings.step_timeout_s) == (2, 4, 600)


def test_settings_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    run = run_with(tmp_path)
    config = run / "config.toml"
    config.write_text(config.read_text().replace("eval_copies = 4", "eval_copies = 0"))
    with pytest.raises(UsageError, match=r"config.toml is damaged: .* `\$.eval_copies`; restore it"):
        playing.play(EvaluateFlags(run=run), lambda line: None)
