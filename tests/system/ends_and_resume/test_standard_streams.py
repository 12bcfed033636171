"""What happens to a run in a real process when its terminal, its output or its locale is not what it should be."""

from __future__ import annotations

import io
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.standard_streams import prepare_streams
from tests.system.stage import preloaded

COMMAND = [sys.executable, "-m", "millrace"]
FLAGS = ["--steps", "600", "--workers", "1", "--eval-episodes", "2", "--rollout-steps", "16", "--n-epochs", "1"]
SOAK = pytest.mark.soak
FULL = Path("/dev/full")
WITHIN_S = 60.0


def train(tmp_path: Path, *flags: str) -> list[str]:
    return [*COMMAND, "train", "CartPole-v1", "--run-dir", str(tmp_path / "runs"), *FLAGS, *flags]


def folder(tmp_path: Path) -> Path:
    (found,) = (tmp_path / "runs").iterdir()
    return found


def wait_for(condition: Callable[[], Any]) -> None:
    deadline_s = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen in time"
        time.sleep(0.02)


def updates(tmp_path: Path) -> int:
    return sum(len(read_rows(path)) for path in tmp_path.glob("runs/*/metrics.jsonl"))


def is_whole(tmp_path: Path) -> bool:
    """Whether the newest checkpoint is of the last update."""
    last = read_rows(folder(tmp_path) / "metrics.jsonl")[-1]
    return bool(checkpoint.newest(folder(tmp_path))[0].env_steps == last["time/total_timesteps"])


def done(tmp_path: Path, command: Sequence[str], **streams: Any) -> None:
    with preloaded.start(command, stdin=subprocess.DEVNULL, cwd=tmp_path, **streams) as process:
        process.communicate(timeout=WITHIN_S)
    assert process.returncode == 0
    assert is_whole(tmp_path)
    assert '"all steps done"' in (folder(tmp_path) / "summary.json").read_text()


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("flags", [[], pytest.param(["--log-json"], marks=SOAK)], ids=["plain", "json"])
def test_a_full_disk_takes_neither_output_nor_errors(tmp_path: Path, flags: list[str]) -> None:
    with FULL.open("wb") as full:
        done(tmp_path, train(tmp_path, *flags), stdout=full, stderr=full)


@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", pytest.param(">&-", marks=SOAK), pytest.param("2>&-", marks=SOAK)])
def test_output_that_is_closed_from_the_start(tmp_path: Path, closed: str) -> None:
    command = ["sh", "-c", f'exec "$@" {closed}', "sh", *train(tmp_path)]
    done(tmp_path, command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_a_reader_that_has_read_enough(tmp_path: Path) -> None:
    with subprocess.Popen(["head", "-1"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as reader:
        assert reader.stdin is not None
        with reader.stdin as output:
            done(tmp_path, train(tmp_path), stdout=output, stderr=output)
        assert reader.stdout is not None
        assert reader.stdout.read().count(b"\n") == 1


def test_a_locale_that_has_only_ascii(tmp_path: Path) -> None:
    """File names and output: without PYTHONIOENCODING, such a locale would allow some other characters in the output."""
    locale = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    (tmp_path / "öä ✓").mkdir()
    command = train(tmp_path / "öä ✓")
    found = subprocess.run(
        command, capture_output=True, timeout=WITHIN_S, check=False, cwd=tmp_path, env={**os.environ, **locale}
    )
    assert (found.returncode, found.stderr) == (0, b"")
    assert b"greedy return" in found.stdout
    assert b"\\xb1" in found.stdout, "the sign that ASCII lacks is not shown as an escape"
    assert is_whole(tmp_path / "öä ✓")
    with pytest.raises(UnicodeDecodeError):
        "±".encode().decode("ascii")


def test_every_command_escapes_what_an_encoding_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, "ascii"))
    prepare_streams()
    sys.stdout.write("return 500 ± 0\n")
    sys.stdout.flush()
    assert shown.getvalue() == b"return 500 \\xb1 0\n"


def test_sighup_ends_a_run_as_sigterm_does(tmp_path: Path) -> None:
    running = preloaded.start(train(tmp_path, "--steps", "1000000"), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    wait_for(lambda: updates(tmp_path) > 3)
    running.send_signal(signal.SIGHUP)
    _, said = running.communicate(timeout=WITHIN_S)
    assert running.returncode == 130
    command = rf"\S*python\S* -m millrace train --resume {re.escape(str(folder(tmp_path)))}"
    go_on = rf"millrace: interrupted; continue with: {command}\n"
    assert re.fullmatch(go_on, said.decode())
    assert is_whole(tmp_path)


def test_a_run_under_nohup_does_not_end_with_its_terminal(tmp_path: Path) -> None:
    with (tmp_path / "out").open("wb") as out:
        running = subprocess.Popen(["nohup", *train(tmp_path, "--steps", "2500")], stdout=out, stderr=out)
    wait_for(lambda: updates(tmp_path) > 3)
    running.send_signal(signal.SIGHUP)
    assert running.wait(WITHIN_S) == 0, (tmp_path / "out").read_text()
    assert is_whole(tmp_path)


@pytest.mark.parametrize("ignores", [False, pytest.param(True, marks=SOAK)], ids=["ends", "nohup"])
def test_a_terminal_that_goes_away(tmp_path: Path, ignores: bool) -> None:
    """The learner has the terminal as its own: when it is closed, the system sends SIGHUP, and every write fails."""
    pid, terminal = pty.fork()
    if not pid:
        if ignores:
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        os.execv(sys.executable, train(tmp_path, "--steps", "2500" if ignores else "1000000"))
    try:
        os.set_blocking(terminal, False)
        wait_for(lambda: _reads(terminal) and updates(tmp_path) > 3)
    finally:
        os.close(terminal)
    codes: list[int] = []

    def ended() -> bool:
        found, status = os.waitpid(pid, os.WNOHANG)
        codes.append(os.waitstatus_to_exitcode(status))
        return found != 0

    wait_for(ended)
    assert codes[-1] == (0 if ignores else 130)
    assert is_whole(tmp_path)


def _reads(terminal: int) -> bool:
    """Read what it shows, so that the learner never waits. True."""
    with suppress(OSError):  # there is nothing to read yet
        os.read(terminal, 65536)
    return True


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
def test_a_command_whose_output_is_its_result_says_that_it_was_not_written(tmp_path: Path) -> None:
    with FULL.open("wb") as full:
        found = subprocess.run([*COMMAND, "presets"], stdout=full, stderr=subprocess.PIPE, timeout=WITHIN_S, check=False)
    assert (found.returncode, found.stderr) == (1, b"millrace: standard output: No space left on device\n")


@pytest.mark.soak
@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
def test_a_learner_and_a_worker_elsewhere_with_a_full_disk(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/learner"
    command = ["-m", "millrace", "learner", "CartPole-v1", "--bind", address, "--run-dir", str(tmp_path / "runs"), *FLAGS]
    with FULL.open("wb") as full:
        both = [
            subprocess.Popen([sys.executable, *arguments], stdin=subprocess.DEVNULL, stdout=full, stderr=full)
            for arguments in (command, ["-m", "millrace", "worker", address])
        ]
    assert [process.wait(WITHIN_S) for process in both] == [0, 0]
    assert is_whole(tmp_path)
