"""A log that others append to stays short: its beginning and its end are kept, and positions in it are known."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from millrace.workers.supervise import short_log, worker_process
from millrace.workers.supervise.short_log import GONE, keep_short
from millrace.workers.supervise.worker_process import WorkerCommand, WorkerProcess

WITHIN_S = 60.0


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(short_log, "MOST", 2_000)
    monkeypatch.setattr(short_log, "BEGINNING", 205)
    monkeypatch.setattr(short_log, "END", 505)


def lines(first: int, last: int) -> bytes:
    """Lines of ten bytes each."""
    return b"".join(b"line %04d\n" % number for number in range(first, last + 1))


def test_a_short_log_stays_as_it_is(tmp_path: Path) -> None:
    log = tmp_path / "w0.log"
    log.write_bytes(lines(1, 200))
    assert keep_short(log, 70) == 70
    assert log.read_bytes() == lines(1, 200)


def test_whole_lines_at_the_beginning_and_at_the_end_stay_and_who_appends_goes_on(tmp_path: Path) -> None:
    log = tmp_path / "w0.log"
    with log.open("ab", buffering=0) as appends:
        appends.write(lines(1, 300))
        keep_short(log, 0)
        appends.write(lines(301, 302))
        kept = lines(1, 20) + GONE + lines(251, 302)
        assert log.read_bytes() == kept
        appends.write(lines(303, 500))
        keep_short(log, 0)
        assert log.read_bytes() == lines(1, 20) + GONE + lines(451, 500)


@pytest.mark.parametrize(
    ("position", "rest"),
    [
        (50, lines(6, 20) + GONE + lines(251, 300)),
        (1_500, lines(251, 300)),
        (2_600, lines(261, 300)),
        (3_000, b""),
    ],
)
def test_a_position_stays_at_what_is_there_or_at_what_follows(position: int, rest: bytes, tmp_path: Path) -> None:
    log = tmp_path / "w0.log"
    log.write_bytes(lines(1, 300))
    now_at = keep_short(log, position)
    assert log.read_bytes()[now_at:] == rest


def test_a_log_of_one_long_line_is_cut_too(tmp_path: Path) -> None:
    log = tmp_path / "w0.log"
    log.write_bytes(b"x" * 5_000)
    keep_short(log, 0)
    assert log.stat().st_size <= 205 + len(GONE) + 505


def test_a_link_in_its_place_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_bytes(lines(1, 300))
    (tmp_path / "w0.log").symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match="symbolic links"):
        keep_short(tmp_path / "w0.log", 0)
    assert (tmp_path / "precious").read_bytes() == lines(1, 300)


def test_a_supervisor_keeps_the_log_of_a_loud_simulator_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loud = "import sys\nfor n in range(1000): print(f'line {n}', flush=True)\nsys.stdin.close()\nsys.exit('the end')"

    def popen(command: list[str], **how: Any) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", loud], **how)

    monkeypatch.setattr(worker_process, "popen", popen)
    log = tmp_path / "w0.log"
    worker = WorkerProcess(WorkerCommand("ipc:///nobody/listens/here", "w0", log))
    monkeypatch.setattr(worker, "_runs", lambda: True)
    os.waitid(os.P_PID, worker.pid, os.WEXITED | os.WNOWAIT)
    worker.end_if_hung(time.monotonic())
    monkeypatch.undo()
    assert log.read_bytes().startswith(b"line 0\n")
    assert log.stat().st_size < 2_000
    worker.wait(WITHIN_S)
    ending = worker.ended()
    assert ending is not None
    assert ending.reason == "ended with exit code 1 while it started (the end)"
