"""log.jsonl of a run folder: what it keeps, and that nothing depends on it."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

import pytest

from millrace.learner.members.events import WorkerLeft, as_extra
from millrace.learner.run_folder import json_log
from millrace.learner.run_folder.json_log import RUN_LOG_FILE, kept_log, newest_lines
from millrace.protocol.logs.notices import log_notice

log = logging.getLogger("millrace.learner")


def test_warnings_and_notices_are_kept_and_the_rest_is_not(tmp_path: Path) -> None:
    with kept_log(tmp_path):
        log.info("a worker joined")
        log.warning("w0 was lost", extra=as_extra(WorkerLeft("w0", "silent", 2, on_purpose=False)))
        log_notice(log, "the run continues")
    log.warning("after the run")
    assert [(line.level, line.message) for line in newest_lines(tmp_path)] == [
        ("warning", "w0 was lost"),
        ("info", "the run continues"),
    ]
    assert '"event":"left"' in (tmp_path / RUN_LOG_FILE).read_text()


def test_a_name_that_would_change_how_a_line_looks_is_escaped(tmp_path: Path) -> None:
    name = "\u202e\u2066\x9b31m"
    with kept_log(tmp_path):
        log.warning("lost", extra=as_extra(WorkerLeft(name, "silent", 2, on_purpose=False)))
    text = (tmp_path / RUN_LOG_FILE).read_text()
    assert text.rstrip("\n").isprintable()
    assert json.loads(text)["worker"] == name


def test_of_a_long_log_the_newer_half_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_log, "MOST_BYTES_OF_LOG", 4_000)
    with kept_log(tmp_path):
        for number in range(200):
            log.warning("line %d", number)
            assert (tmp_path / RUN_LOG_FILE).stat().st_size <= 4_000
    numbers = [int(line.message.partition(" ")[2]) for line in newest_lines(tmp_path)]
    assert numbers == [*range(numbers[0], 200)]
    assert len(numbers) >= 10


def test_lines_that_cannot_be_read_are_left_out(tmp_path: Path) -> None:
    with kept_log(tmp_path):
        log.warning("before")
        with (tmp_path / RUN_LOG_FILE).open("ab") as file:
            file.write(b'\xff\n[[[\n{"time":"yesterday","level":"warning","message":"odd"}\n')
            for time in ("2026-01-01T00:00:00", "0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59"):
                file.write(b'{"time":"%s","level":"warning","message":"of no known time"}\n' % time.encode())
        log.warning("after")
    assert [line.message for line in newest_lines(tmp_path)] == ["before", "after"]
    assert newest_lines(tmp_path / "no-such") == []


def test_a_log_that_cannot_be_written_ends_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with kept_log(tmp_path / "deleted"):
        log.warning("nobody keeps this")
    target = tmp_path / "target"
    target.touch()
    os.symlink(target, tmp_path / RUN_LOG_FILE)
    with kept_log(tmp_path):
        log.warning("a link is not followed")
    assert target.read_bytes() == b""
    assert newest_lines(tmp_path) == []
    assert capsys.readouterr().err == ""
