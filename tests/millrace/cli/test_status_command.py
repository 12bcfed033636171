"""`millrace status RUN`: whom it asks, and with which token. The learner's answer is tested elsewhere."""

from __future__ import annotations

import io
import json
import os
import re
from datetime import UTC, datetime
from pathlib import Path

import pytest
from msgspec.structs import replace

from millrace.cli.main import main
from millrace.cli.status import status, token_of_learner, whom_to_ask
from millrace.learner.run_folder.lease import Listens, Owner, decoded
from millrace.learner.run_folder.run_lock import LOCK_FILE, RunLock
from millrace.protocol.errors import UsageError
from millrace.protocol.keys.key_folder import KeyFolder
from millrace.protocol.keys.keys import Key, Token
from millrace.protocol.keys.worker_token import read_token
from millrace.protocol.progress import RunProgress
from tests.support.run_folders import a_run, write_progress

NOW = datetime(2026, 11, 21, 10, tzinfo=UTC)
WIDE, HERE = "tcp://box:5555", "tcp://127.0.0.1:5555"


@pytest.fixture
def keys(tmp_path: Path) -> KeyFolder:
    folder = KeyFolder(tmp_path / "keys")
    folder.new("default", NOW)
    return folder


@pytest.fixture
def run(tmp_path: Path) -> Path:
    path = tmp_path / "run"
    path.mkdir()
    return path


def write_lock(run: Path, keys: str, boot: str = "", host: str = "box") -> None:
    """The lock of a learner that lives, on this machine unless `boot` names another one."""
    (run / LOCK_FILE).unlink(missing_ok=True)  # a lock of another machine would be watched for half a minute
    with RunLock(run) as lock:
        lock.announce(Listens(WIDE, HERE, keys))
        owner = decoded((run / LOCK_FILE).read_bytes())
    assert owner is not None
    (run / LOCK_FILE).write_bytes(_elsewhere(owner, boot, host).encoded())


def _elsewhere(owner: Owner, boot: str, host: str) -> Owner:
    return replace(owner, boot_id=boot, host=host) if boot else owner


def test_a_learner_here_is_asked_with_the_token_of_its_key_folder(run: Path, keys: KeyFolder) -> None:
    write_lock(run, str(keys.path))
    assert whom_to_ask(str(run), None, insecure=False) == (HERE, read_token(str(keys.token_path("default"))))


def test_a_token_that_was_given_comes_first(run: Path, keys: KeyFolder) -> None:
    write_lock(run, str(keys.path))
    given = Token(Key.new().public, Key.new())
    assert whom_to_ask(str(run), given, insecure=False) == (HERE, given)


def test_a_learner_here_without_keys_is_asked_without_a_token(run: Path) -> None:
    write_lock(run, "")
    of_another_learner = Token(Key.new().public, Key.new())
    for token in (None, of_another_learner):
        assert whom_to_ask(str(run), token, insecure=False) == (HERE, None)


def test_a_learner_elsewhere_is_asked_with_a_token_if_its_key_folder_is_shared(run: Path, keys: KeyFolder) -> None:
    write_lock(run, str(keys.path), boot="another kernel")
    assert whom_to_ask(str(run), None, insecure=False) == (WIDE, read_token(str(keys.token_path("default"))))
    write_lock(run, "", boot="another kernel")
    with pytest.raises(UsageError, match="--insecure connects without"):
        whom_to_ask(str(run), None, insecure=False)


@pytest.mark.parametrize("boot", ["", "another kernel"])
def test_a_folder_without_a_token_is_one_line_that_does_not_suggest_to_go_without(
    run: Path, keys: KeyFolder, boot: str
) -> None:
    keys.revoke("default", NOW)
    write_lock(run, str(keys.path), boot)
    with pytest.raises(
        UsageError, match=rf"no token is in {keys.path} here: expected --token FILE .*keys new NAME"
    ) as raised:
        whom_to_ask(str(run), None, insecure=False)
    assert "insecure" not in str(raised.value)
    assert "\n" not in str(raised.value)
    write_lock(run, str(keys.path / "not-here"), boot)
    with pytest.raises(UsageError, match="no token is in"):
        whom_to_ask(str(run), None, insecure=False)


@pytest.mark.parametrize("content", ["large", "long key", "a link", "a FIFO", "not text", "a folder"])
def test_a_list_that_would_take_long_to_read_is_refused(run: Path, keys: KeyFolder, content: str) -> None:
    path = keys.list_path
    path.rename(path.with_name("real"))
    match content:
        case "a link":
            path.symlink_to("real")
        case "a FIFO":
            os.mkfifo(path)
        case "a folder":
            path.mkdir()
        case "large":
            path.write_text("# nothing\n" * 50_000)
        case "not text":
            path.write_bytes(b"\xff")
        case _:
            path.write_text(".".join(["a"] * 5_000) + " = 1\n")
    write_lock(run, str(keys.path), "another kernel")
    with pytest.raises(UsageError, match=r"cannot be read: |has tables in tables in tables") as raised:
        whom_to_ask(str(run), None, insecure=False)
    assert "\n" not in str(raised.value)


def test_a_key_folder_inside_the_run_folder_is_refused(run: Path, keys: KeyFolder, tmp_path: Path) -> None:
    """Whoever hands over a run folder would choose the key by which their program counts as the right learner."""
    keys.path.rename(run / "keys")
    (tmp_path / "link").symlink_to(run)
    for folder in (run / "keys", run / "x" / ".." / "keys", tmp_path / "link" / "keys"):
        write_lock(run, str(folder), "another kernel")
        with pytest.raises(UsageError, match=r"names a key folder inside the run folder; expected --token FILE"):
            whom_to_ask(str(run), None, insecure=False)


@pytest.mark.parametrize("folder", ["x\0y", "x" * 300])
def test_a_key_folder_that_cannot_exist_is_one_line(run: Path, folder: str) -> None:
    with pytest.raises(UsageError, match="cannot be read"):
        token_of_learner(str(run), Path(folder))


@pytest.mark.skipif(os.getuid() == 0, reason="root may read every folder")
def test_a_folder_of_another_user_is_one_line(run: Path, keys: KeyFolder) -> None:
    write_lock(run, str(keys.path))
    keys.path.chmod(0)
    try:
        with pytest.raises(UsageError, match="cannot be read: Permission denied; expected --token FILE"):
            whom_to_ask(str(run), None, insecure=False)
    finally:
        keys.path.chmod(0o700)


def test_a_run_that_nobody_trains_shows_how_it_ended(tmp_path: Path) -> None:
    out, as_json = io.StringIO(), io.StringIO()
    ended = a_run(tmp_path)
    status([str(ended)], out)
    assert out.getvalue().startswith("Finished: all steps done.\nCartPole-v1, PPO, seed 1: 123,456 of ")
    status([str(ended), "--json"], as_json)
    found = json.loads(as_json.getvalue())
    assert (found["type"], found["state"], found["summary"]["updates"]) == ("LastState", "finished", 789)


def test_runs_are_listed_in_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "runs", finished=False)
    assert main(["list", str(tmp_path / "runs")]) == 0
    head, row = capsys.readouterr().out.splitlines()
    columns = ["run", "state", "environment", "algorithm", "return", "env steps", "done", "steps/s", "started"]
    assert re.split(r"  +", head) == columns
    assert "2%, no sign since 20" in row
    assert row.split()[:7] == [run.name, "dead", "CartPole-v1", "PPO", "101.0", "2,000", "2%,"]
    write_progress(run, RunProgress(total_steps=100_000))
    with RunLock(run):
        assert main(["list", str(tmp_path / "runs")]) == 0
    row = capsys.readouterr().out.splitlines()[1]
    assert re.split(r"  +", row)[1:8] == ["training", "CartPole-v1", "PPO", "-", "-", "before its first update", "-"]
    write_progress(run, RunProgress(env_steps=99_900, collected=512, total_steps=100_000))
    assert main(["list", str(tmp_path / "runs")]) == 0
    assert re.split(r"  +", capsys.readouterr().out.splitlines()[1])[5] == "100,000", "no update uses more"
    (tmp_path / "empty").mkdir()
    assert main(["list", str(tmp_path / "empty")]) == 0
    assert capsys.readouterr().out == "no run is here\n"
