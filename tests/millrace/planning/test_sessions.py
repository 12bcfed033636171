"""Whether copies failed because of their number: several tries, compared with one copy alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from millrace.planning.probe_sizes import SessionSize
from millrace.planning.random_actions import SeenMasks
from millrace.planning.sessions import Failures, SteppedCopies, Tries
from millrace.planning.stopwatch import CopyTimes

CRASH = "worker w0 was killed"


def session(workers: int, steps: int, wrong: str = "", *, each: int = 1, cut_off: bool = False) -> SteppedCopies:
    """A session in which each copy took so many steps."""
    size = SessionSize(workers, each)
    times = [CopyTimes(np.zeros((steps, 4)), np.zeros((1, 4)), np.zeros((0, 3))) for _ in range(size.copies)]
    traces = [[0] * (steps + 1) for _ in range(size.copies)]
    known: Any = (None, None, (), None)
    return SteppedCopies(size, times, traces, 0.5, wrong, cut_off, SeenMasks(False, ""), *known)


ALONE = session(1, 80)


@pytest.mark.parametrize("copies", [2, 8, 16])
def test_copies_that_cannot_even_begin_failed_because_of_their_number(copies: int) -> None:
    tries = Tries((session(copies, 0, CRASH),) * 3, ALONE)
    assert tries.show_a_limit
    assert not tries.worked
    assert tries.finding.startswith(f"{copies} copies side by side: {CRASH} (in all 3 tries); if a copy needs a port")
    assert Failures.of([Tries((ALONE,), None), tries]) == ((), 81)


@pytest.mark.parametrize("failed", [1, 2])
def test_if_there_is_one_more_try_and_it_works_the_number_of_copies_is_no_limit(failed: int) -> None:
    tries = Tries((*[session(16, 0, CRASH)] * failed, session(16, 40)), ALONE)
    assert tries.worked
    assert not tries.show_a_limit
    assert tries.longest.wrong == ""
    assert tries.finding == ""
    assert len(Failures.of([tries]).sessions) == failed


@pytest.mark.parametrize(("copies", "steps"), [(2, 100), (2, 20), (8, 20), (16, 10)])
def test_crashes_that_are_about_as_frequent_as_they_may_be_with_one_copy_limit_nothing(copies: int, steps: int) -> None:
    tries = Tries((session(copies, steps, CRASH),), ALONE)
    assert tries.worked
    assert tries.finding == ""
    failures = Failures.of([Tries((ALONE,), None), tries])
    calls = 81 + copies * (steps + 1)
    assert (failures.sessions, failures.calls) == ((tries.longest,), calls)
    assert failures.finding.startswith(f"1 failure in {calls:,} steps and resets (")
    assert f", {copies} copies side by side, after {copies * (steps + 1)} calls: {CRASH}; a run starts" in failures.finding


def test_crashes_that_are_much_more_frequent_than_with_one_copy_are_a_limit_unless_that_crashed_too() -> None:
    early = (session(2, 5, CRASH), session(2, 7, CRASH), session(2, 6, CRASH))
    assert Tries(early, ALONE).show_a_limit
    assert not Tries(early, ALONE).worked
    assert not Tries(early, session(1, 20)).show_a_limit
    assert not Tries(early, session(1, 60, CRASH)).show_a_limit
    assert Tries(early, session(1, 80, CRASH)).show_a_limit


def test_if_there_is_no_time_for_a_second_try_the_finding_says_so() -> None:
    tries = Tries((session(4, 0, CRASH), session(4, 0, cut_off=True)), ALONE)
    assert tries.show_a_limit
    assert "(there was no time for a second try)" in tries.finding


def test_copies_for_which_the_time_is_up_neither_worked_nor_failed() -> None:
    tries = Tries((session(4, 1, cut_off=True),), ALONE)
    assert not tries.show_a_limit
    assert not tries.worked
    assert tries.finding.startswith("4 copies side by side were not measured")
    assert Failures.of([tries]).finding == ""


def test_two_copies_in_one_worker_are_tried_unless_the_result_is_known() -> None:
    assert Tries((session(2, 0, CRASH),), ALONE).decide_about_two
    assert Tries((session(1, 50, each=8),), ALONE).decide_about_two
    assert Tries((session(1, 50, CRASH, each=8),), ALONE).decide_about_two
    assert not Tries((session(1, 0, CRASH, each=8),), ALONE).decide_about_two
    assert not Tries((session(2, 50, CRASH),), ALONE).decide_about_two
