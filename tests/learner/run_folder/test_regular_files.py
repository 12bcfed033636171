"""Only regular files inside a run folder are read and written. What a link names outside of it is left alone."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from millrace.launch.crew import crew_of_run
from millrace.learner.config.config import Config
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.atomic_write import write_atomically
from millrace.learner.run_folder.metrics_log import MetricsLog
from millrace.learner.run_folder.regular_files import open_regular, read, regular_files, subfolder
from millrace.learner.run_folder.run_lock import RunLock
from millrace.protocol.errors import UserFacingError

KEY = b"a private key"


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "key").write_bytes(KEY)
    return tmp_path / "outside"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


def bound_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        folder = Path.cwd()
        os.chdir(path.parent)  # because its path may be too long for a socket
        made.bind(path.name)
        os.chdir(folder)


@pytest.mark.parametrize(
    ("put", "got"),
    [
        (lambda path, outside: path.symlink_to(outside / "key"), "a link"),
        (lambda path, outside: path.symlink_to(outside / "nothing"), "a link"),
        (lambda path, outside: path.symlink_to("/dev/zero"), "a link"),
        (lambda path, outside: os.mkfifo(path), "a FIFO"),
        (lambda path, outside: path.mkdir(), "a folder"),
        (lambda path, outside: bound_socket(path), "a socket"),
    ],
)
def test_anything_but_a_regular_file_is_refused_at_once(
    run: Path, outside: Path, put: Callable[[Path, Path], object], got: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = run / "observation.png"
    put(path, outside)
    for flags in (os.O_RDONLY, os.O_RDWR, os.O_WRONLY | os.O_APPEND | os.O_CREAT, os.O_WRONLY | os.O_TRUNC):
        with pytest.raises(OSError, match=f"expected a file, got {got}"):
            open_regular(path, flags)
    with pytest.raises(OSError, match=f"expected a file, got {got}"):
        read(path)
    assert regular_files(run, "*.png") == []
    assert [record.getMessage() for record in caplog.records] == [f"{path}: expected a file, got {got}; it is left out"]
    assert {each.name: each.read_bytes() for each in outside.iterdir()} == {"key": KEY}


def test_a_file_that_is_too_large_is_not_read(run: Path) -> None:
    (run / "summary.json").write_bytes(b"12345")
    assert read(run / "summary.json", 5) == b"12345"
    with pytest.raises(OSError, match="expected at most 4 bytes, got 5"):
        read(run / "summary.json", 4)


WRITERS: dict[str, Callable[[Path], object]] = {
    "run.lock": lambda run: RunLock(run).__enter__(),
    "metrics.jsonl": MetricsLog,
    "workers/w0.log": lambda run: crew_of_run(Config(), run),
    "checkpoints": lambda run: checkpoint.save(run, {}, env_steps=1, keep=3),
    "workers": lambda run: crew_of_run(Config(), run),
    "videos": lambda run: subfolder(run, "videos"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_run_writes_nothing_through_a_link(run: Path, outside: Path, name: str) -> None:
    is_file = "." in name
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).symlink_to(outside / "key" if is_file else outside)
    with pytest.raises((UserFacingError, OSError), match=f"expected a {'file' if is_file else 'folder'}, got a link"):
        WRITERS[name](run)
    assert {each.name: each.read_bytes() for each in outside.iterdir()} == {"key": KEY}


def test_a_file_replaces_a_link_of_its_name_and_of_its_temporary_name(run: Path, outside: Path) -> None:
    for name in ("policy.json", "policy.json.tmp"):
        (run / name).symlink_to(outside / "key")
    write_atomically(run / "policy.json", lambda file: file.write(b"new"))
    assert {each.name: each.read_bytes() for each in run.iterdir()} == {"policy.json": b"new"}
    assert not (run / "policy.json").is_symlink()
    assert (outside / "key").read_bytes() == KEY


def test_the_run_folder_itself_may_be_named_by_a_link(run: Path, tmp_path: Path) -> None:
    (tmp_path / "newest").symlink_to(run)
    (run / "observation.png").write_bytes(b"a picture")
    assert regular_files(tmp_path / "newest", "*.png") == [tmp_path / "newest" / "observation.png"]
    assert subfolder(tmp_path / "newest", "videos").is_dir()
    assert read(tmp_path / "newest" / "observation.png") == b"a picture"
