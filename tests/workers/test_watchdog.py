"""The watchdog, in processes of its own: it ends a process that hangs, and reports where it hung."""

from __future__ import annotations

import faulthandler
import math
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from millrace.workers import watchdog
from millrace.workers.watchdog import Watchdog, deepest_frame, where_it_hung

PROGRAM = """
import re, sys, threading, time
from millrace.workers.watchdog import Watchdog

def step():
    {hang}

threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
watchdog = Watchdog(lambda: {timeout_s})
watchdog.feed(time.monotonic())
step()
watchdog.stop()
time.sleep({after_s})
print("alive")
"""
OURS = watchdog.__file__
FEED_OFTEN = "for _ in range(12): watchdog.feed(time.monotonic()); time.sleep(0.1)"


def run_program(tmp_path: Path, hang: str, timeout_s: float, after_s: float = 0) -> subprocess.CompletedProcess[str]:
    script = tmp_path / "script.py"
    script.write_text(PROGRAM.format(hang=hang, timeout_s=timeout_s, after_s=after_s))
    root = str(Path(__file__).parents[2])
    return subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=60, env={"PYTHONPATH": root}, check=False
    )


@pytest.mark.parametrize("hang", ["time.sleep(60)", "re.match('(a+)+$', 'a' * 60 + 'b')"], ids=["sleeps", "in C, lock held"])
def test_a_process_that_hangs_is_ended_and_the_line_is_reported(tmp_path: Path, hang: str) -> None:
    found = run_program(tmp_path, hang, 0.3)
    assert (found.returncode, found.stdout) == (1, "")
    assert "script.py" in found.stderr
    where = where_it_hung(found.stderr)
    assert where is not None
    assert where.endswith("in step") or "in match" in where


def test_a_process_that_feeds_or_stops_the_watchdog_is_not_ended(tmp_path: Path) -> None:
    assert run_program(tmp_path, FEED_OFTEN, 0.5, after_s=1.0).stdout == "alive\n"


@pytest.mark.parametrize("stderr", ["None", "io.StringIO()"])
def test_it_works_if_the_environment_has_replaced_stderr(tmp_path: Path, stderr: str) -> None:
    replaced = f"import io; sys.stderr = {stderr}; watchdog.feed(time.monotonic() + 9); time.sleep(60)"
    found = run_program(tmp_path, replaced, 0.3)
    assert (found.returncode, found.stdout) == (1, "")
    assert where_it_hung(found.stderr) is not None


def test_output_without_a_hang_has_no_line() -> None:
    assert where_it_hung("Traceback …\nValueError: no") is None
    assert where_it_hung("said before\nTimeout (0:02:00)!\n") == "an unknown place"


@pytest.mark.parametrize(
    ("newest_first", "where"),
    [
        (
            [socket.__file__, "/venv/lib/python3.11/site-packages/sim/api.py", "/home/me/my_env.py", OURS],
            "/home/me/my_env.py",
        ),
        (["<frozen importlib._bootstrap>", "/usr/lib/python3/dist-packages/sim.py", OURS], "<frozen importlib._bootstrap>"),
    ],
    ids=["in the user's code", "in none of it"],
)
def test_the_line_is_the_newest_of_the_users_own_code(newest_first: list[str], where: str) -> None:
    stack = "\n".join(f'  File "{file}", line 7 in call' for file in newest_first)
    other = 'Thread 0x1 (most recent call first):\n  File "/home/me/other.py", line 1 in wait\n'
    assert deepest_frame(f"{other}\nCurrent thread 0x2 (most recent call first):\n{stack}\n") == f"{where}:7, in call"


@pytest.mark.parametrize("timeout_s", [math.inf, 1e300])
def test_a_time_that_is_longer_than_any_timer_is_no_error(timeout_s: float) -> None:
    watchdog = Watchdog(lambda: timeout_s)
    watchdog.feed(0.0)
    watchdog.stop()


def test_the_timer_is_set_at_once_when_another_run_allows_another_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that no run has welcomed may wait for ever; the first thing that a run asks for may hang."""
    timers: list[float] = []
    monkeypatch.setattr(faulthandler, "dump_traceback_later", lambda timeout_s, exit, file: timers.append(timeout_s))
    monkeypatch.setattr(faulthandler, "cancel_dump_traceback_later", lambda: timers.append(math.inf))
    allowed_s = [math.inf, 100.0, 100.0, 8.0, math.inf]
    watchdog = Watchdog(lambda: allowed_s[0])
    while allowed_s:
        watchdog.feed(0.0)
        allowed_s.pop(0)
    assert timers == [math.inf, 101.0, 9.0, math.inf]
