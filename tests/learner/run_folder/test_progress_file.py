"""progress.json: how far a run is, also once its process is gone."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import pytest

from millrace.learner.run_folder.checkpoint import FOLDER, SUFFIX
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.progress_file import (
    EVERY_S,
    LONGEST_SILENCE_S,
    PROGRESS_FILE,
    ProgressFile,
    last_progress,
    progress_before,
)
from millrace.learner.run_folder.results import Summary
from millrace.protocol.progress import RunProgress
from tests.support.run_folders import a_run

BEGAN_S = 1_800_000_000.0


def at(env_steps: int) -> RunProgress:
    return RunProgress(env_steps=env_steps, total_steps=100)


def test_it_is_written_once_a_second(tmp_path: Path) -> None:
    now = BEGAN_S
    file = ProgressFile(tmp_path)
    file.write(lambda: at(10), now)
    now += EVERY_S / 2
    file.write(lambda: pytest.fail("it is not even asked for"), now)
    assert last_progress(tmp_path, None) == msgspec.structs.replace(at(10), at_s=BEGAN_S)
    now += EVERY_S / 2
    file.write(lambda: at(20), now)
    assert last_progress(tmp_path, None) == msgspec.structs.replace(at(20), at_s=BEGAN_S + EVERY_S)
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == [PROGRESS_FILE]


def test_a_clock_that_is_set_back_does_not_stop_it(tmp_path: Path) -> None:
    now = BEGAN_S
    file = ProgressFile(tmp_path)
    file.write(lambda: at(10), now)
    now -= 3_600.0
    file.write(lambda: at(20), now)
    assert last_progress(tmp_path, None).env_steps == 20


def test_what_has_not_changed_is_not_written_again(tmp_path: Path) -> None:
    now = BEGAN_S
    file = ProgressFile(tmp_path)
    file.write(lambda: at(10), now)
    before = (tmp_path / PROGRESS_FILE).stat()
    now += EVERY_S
    file.write(lambda: at(10), now)
    assert os.path.samestat((tmp_path / PROGRESS_FILE).stat(), before), "another file stands in its place"


def test_a_run_that_stands_still_gives_a_sign_of_itself(tmp_path: Path) -> None:
    file = ProgressFile(tmp_path)
    for second in range(int(2 * LONGEST_SILENCE_S)):
        file.write(lambda: at(10), BEGAN_S + second)
    now = BEGAN_S + second
    assert now - last_progress(tmp_path, None).at_s < LONGEST_SILENCE_S


def test_what_the_disk_refuses_is_dropped_and_written_later(tmp_path: Path) -> None:
    now = BEGAN_S
    run = tmp_path / "run"
    file = ProgressFile(run)
    file.write(lambda: at(10), now)  # the folder was deleted
    run.mkdir()
    now += EVERY_S
    file.write(lambda: at(20), now)
    assert last_progress(run, None).env_steps == 20


def test_a_run_that_is_resumed_is_as_far_as_its_newest_checkpoint_and_goes_to_the_new_end(tmp_path: Path) -> None:
    assert progress_before(None, 500) == progress_before(tmp_path, 500) == RunProgress(total_steps=500)
    (tmp_path / FOLDER).mkdir()
    for env_steps in (200, 300):
        (tmp_path / FOLDER / f"{env_steps:012d}{SUFFIX}").touch()
    assert progress_before(tmp_path, 500) == RunProgress(env_steps=300, total_steps=500)


def test_what_was_refused_is_written_although_nothing_has_changed_since(tmp_path: Path) -> None:
    now = BEGAN_S
    run = tmp_path / "run"
    file = ProgressFile(run)
    file.write(lambda: at(10), now)
    run.mkdir()
    now += EVERY_S
    file.write(lambda: at(10), now)
    assert last_progress(run, None).env_steps == 10


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b'{"env_steps": -5}', b'{"at_s": 1e300}', b'{"stages": {"a": 1e999}}', b'{"wall_s": 1e308}', b"\xff"],
)
def test_of_a_damaged_file_nothing_is_known_but_the_settings(tmp_path: Path, content: bytes) -> None:
    (tmp_path / PROGRESS_FILE).write_bytes(content)
    assert last_progress(tmp_path, None, 100) == RunProgress(total_steps=100)


def test_no_link_is_followed_and_no_pipe_is_waited_for(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text('{"env_steps": 7}')
    run = tmp_path / "run"
    run.mkdir()
    (run / PROGRESS_FILE).symlink_to(secret)
    assert last_progress(run, None) == RunProgress()
    (run / PROGRESS_FILE).unlink()
    os.mkfifo(run / PROGRESS_FILE)
    assert last_progress(run, None) == RunProgress()
    ProgressFile(run).write(lambda: at(10), BEGAN_S)
    assert last_progress(run, None).env_steps == 10
    assert secret.read_text() == '{"env_steps": 7}'


def test_a_summary_counts_more(tmp_path: Path) -> None:
    run = a_run(tmp_path, finished=False)
    summary = Summary(
        env="CartPole-v1",
        algo="ppo",
        seed=1,
        env_steps=123,
        updates=4,
        wall_s=5.0,
        env_steps_per_s=6.0,
        stop_reason="interrupted",
        cut_short=True,
        return_mean_100=7.0,
        evaluation=None,
        ledger={"used": 8},
        stages={"learner_wait": 9.0},
    )
    assert last_progress(run, summary, 200) == RunProgress(
        env_steps=123,
        total_steps=200,
        updates=4,
        wall_s=5.0,
        steps_per_s=6.0,
        return_mean=7.0,
        ledger={"used": 8},
        stages={"learner_wait": 9.0},
        stop_reason="interrupted",
        cut_short=True,
    )
    assert last_progress(run, None).env_steps == 2_000


def test_what_callbacks_get_besides_is_not_written() -> None:
    told = Progress(env_steps=5, settings={"seed": 1}, metrics={"a": 1.0}, checkpoint="here")
    assert told.plain() == RunProgress(env_steps=5)
    assert told.plain().__class__ is RunProgress
