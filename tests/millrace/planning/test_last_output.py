"""What a simulator wrote last before it failed, from a worker's log."""

from __future__ import annotations

from pathlib import Path

import pytest

from millrace.planning.last_output import with_last_output

WRONG = "worker w3 (host): lane 3, copy 0, reset: its environment raised ConnectionError: simulator ended with code 3"
JOINS = "2026-11-30 18:54:53,838 worker w3: joined\n"
FAILS = (
    "2026-11-30 18:54:54,838 worker w3: lane 3, copy 0, reset: its environment raised ConnectionError\n"
    "Traceback (most recent call last):\n  File\nConnectionError\n\n"
    "During handling, another exception occurred:\n\nTraceback (most recent call last):\nConnectionError\n"
)
SEATS = "licence error: 3 of 3 seats in use"


@pytest.mark.parametrize(
    ("log", "wrote"),
    [
        (f"starts\n{SEATS}\n{JOINS}\n{FAILS}", SEATS),
        (f"{JOINS}{SEATS}\n{FAILS}closing\n", SEATS),
        (f"{JOINS}{SEATS}\n", SEATS),
        (f"{JOINS}{FAILS}", ""),
        ("", ""),
        ("simulator ended with code 3\n", ""),  # the error says so
    ],
)
def test_the_last_line_before_the_failure_that_millrace_did_not_write(tmp_path: Path, log: str, wrote: str) -> None:
    (tmp_path / "w3.log").write_text(log)
    (tmp_path / "w2.log").write_text("other\n")
    assert with_last_output(WRONG, tmp_path) == (f"{WRONG}; w3 wrote: {wrote}" if wrote else WRONG)


@pytest.mark.parametrize("wrong", [WRONG, "a call took longer than 9 s"])
def test_without_a_log_or_a_worker_the_error_stays_as_it_is(tmp_path: Path, wrong: str) -> None:
    assert with_last_output(wrong, tmp_path) == wrong
