"""For how much of the time this machine's cores are idle, from what Linux counts for each core."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from millrace.protocol.machine.core_times import CoreTimes, core_times, idle_share

STAT = """\
cpu  44 0 8 120 8 0 0 20 4 4
cpu0 20 1 2 30 3 4 5 6 7 8
cpu1 12 0 3 45 0 0 0 7 0 0
cpu10 12 0 3 45 5 0 0 7 0 0
intr 5 6 7
"""


@pytest.mark.parametrize(("cores", "times"), [({0}, (33, 71)), ({1}, (45, 67)), ({0, 10}, (83, 143)), ({7}, (0, 0))])
def test_only_the_cores_that_this_process_may_use_count(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, cores: set[int], times: tuple[int, int]
) -> None:
    """Time that waits for a disk is idle. Time of virtual machines is part of the first two times."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: cores)
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/stat").write_text(STAT)
    assert core_times(tmp_path) == times


def test_the_share_is_of_the_time_between_two_readings() -> None:
    assert idle_share(CoreTimes(100, 1000), CoreTimes(130, 1120)) == 0.25


def test_cores_whose_time_is_not_counted_are_not_known_to_be_idle(tmp_path: Path) -> None:
    assert core_times(tmp_path) == (0, 0)
    assert idle_share(core_times(tmp_path), core_times(tmp_path)) == 0.0


def test_the_times_of_this_machine_never_fall() -> None:
    before, after = core_times(), core_times()
    assert 0 < before.total <= after.total
    assert before.idle < before.total
