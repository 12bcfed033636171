"""The watchdog, in processes of its own: who is fed lives, who hangs is ended, and it is said where."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from workers.watchdog import where_it_hung

PROGRAM = """
import re, sys, threading, time
from workers.watchdog import Watchdog

def step():
    {hang}

threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
watchdog = Watchdog({timeout_s})
watchdog.feed(time.monotonic())
step()
watchdog.stop()
time.sleep({after_s})
print("alive")
"""
FEEDS = "for _ in range(12): watchdog.feed(time.monotonic()); time.sleep(0.1)"


def played(tmp_path: Path, hang: str, timeout_s: float, after_s: float = 0) -> subprocess.CompletedProcess[str]:
    script = tmp_path / "script.py"
    script.write_text(PROGRAM.format(hang=hang, timeout_s=timeout_s, after_s=after_s))
    root = str(Path(__file__).parents[2])
    return subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=60, env={"PYTHONPATH": root}, check=False
    )


@pytest.mark.parametrize("hang", ["time.sleep(60)", "re.match('(a+)+$', 'a' * 60 + 'b')"], ids=["sleeps", "in C, lock held"])
def test_one_that_hangs_is_ended_and_it_is_said_where(tmp_path: Path, hang: str) -> None:
    found = played(tmp_path, hang, 0.3)
    assert (found.returncode, found.stdout) == (1, "")
    assert "script.py" in found.stderr
    where = where_it_hung(found.stderr)
    assert where is not None
    assert where.endswith("in step") or "in match" in where


def test_one_that_is_fed_lives_and_so_does_one_that_is_watched_no_more(tmp_path: Path) -> None:
    assert played(tmp_path, FEEDS, 0.5, after_s=1.0).stdout == "alive\n"


def test_a_log_without_a_hang_tells_of_none() -> None:
    assert where_it_hung("Traceback …\nValueError: no") is None
    assert where_it_hung("said before\nTimeout (0:02:00)!\n") == "an unknown place"
