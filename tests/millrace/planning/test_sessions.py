"""Whether copies failed because of their number: several tries, compared with one copy alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from millrace.planning.probe_sizes import SessionSize
from millrace.planning.random_actions import SeenMasks
from millrace.planning.sessions import TRIES, Failures, SteppedCopies, Tries, hangs
from millrace.planning.stopwatch import CopyTimes

CRASH = "worker w0 was killed"
STEP_S, RESET_S = 0.5, 7.0
ENOUGH_S = 1620.0


def session(
    workers: int, steps: int, wrong: str = "", *, each: int = 1, cut_off: bool = False, stepped_s: float = 0.0
) -> SteppedCopies:
    """A session in which each copy took so many steps."""
    size = SessionSize(workers, each)
    times = [CopyTimes(np.zeros((steps, 4)), np.zeros((1, 4)), np.zeros((0, 3))) for _ in range(size.copies)]
    traces = [[0] * (steps + 1) for _ in range(size.copies)]
    known: Any = (None, None, (), None)
    return SteppedCopies(size, times, traces, 0.5, wrong, cut_off, stepped_s, SeenMasks(False, ""), *known)


def alone(steps: int, *wrong: str) -> Tries:
    """Sessions with one copy, each with so many steps: one in which nothing went wrong, or those that these errors ended."""
    return Tries(tuple(session(1, steps, each) for each in wrong or [""]), None)


ALONE = alone(80)


@pytest.mark.parametrize("copies", [2, 8, 16])
def test_copies_that_cannot_even_begin_failed_because_of_their_number(copies: int) -> None:
    tries = Tries((session(copies, 0, CRASH),) * 3, ALONE)
    assert tries.show_a_limit
    assert not tries.worked
    failed = f"{copies} copies side by side: {CRASH} (in all 3 tries)"
    assert tries.finding(ENOUGH_S).startswith(f"{failed}; if a copy needs a port")
    assert Failures.of([ALONE, tries]) == ((), 81, 0.0)


@pytest.mark.parametrize("failed", [1, 2])
def test_if_there_is_one_more_try_and_it_works_the_number_of_copies_is_no_limit(failed: int) -> None:
    tries = Tries((*[session(16, 0, CRASH)] * failed, session(16, 40)), ALONE)
    assert tries.worked
    assert not tries.show_a_limit
    assert tries.longest.wrong == ""
    assert tries.finding(ENOUGH_S) == ""
    assert len(Failures.of([tries]).sessions) == failed


@pytest.mark.parametrize(("copies", "steps"), [(2, 100), (2, 20), (8, 20), (16, 10)])
def test_crashes_that_are_about_as_frequent_as_they_may_be_with_one_copy_limit_nothing(copies: int, steps: int) -> None:
    tries = Tries((session(copies, steps, CRASH),), ALONE)
    assert tries.worked
    assert tries.finding(ENOUGH_S) == ""
    failures = Failures.of([ALONE, tries])
    calls = 81 + copies * (steps + 1)
    assert (failures.sessions, failures.calls) == ((tries.longest,), calls)
    assert failures.finding.startswith(f"1 failure in {calls:,} steps and resets (")
    assert f", {copies} copies side by side, after {copies * (steps + 1)} calls: {CRASH}; a run starts" in failures.finding


def test_crashes_that_are_much_more_frequent_than_with_one_copy_are_a_limit_unless_that_crashed_too() -> None:
    early = (session(2, 5, CRASH), session(2, 7, CRASH), session(2, 6, CRASH))
    assert Tries(early, ALONE).show_a_limit
    assert not Tries(early, ALONE).worked
    assert not Tries(early, alone(20)).show_a_limit
    assert not Tries(early, alone(60, CRASH)).show_a_limit
    assert Tries(early, alone(80, CRASH)).show_a_limit
    assert Tries(early, alone(60, CRASH, CRASH)).show_a_limit


def test_the_time_of_failures_is_that_of_all_steps_and_resets_of_the_sessions_that_are_counted() -> None:
    steps, resets = np.full((10, 4), STEP_S), np.full((3, 4), RESET_S)
    timed = ALONE.longest._replace(times=[CopyTimes(steps, resets, np.zeros((0, 3)))] * 2)
    failures = Failures.of([Tries((timed,), None), Tries((timed._replace(wrong=CRASH),), ALONE)])
    assert failures.calls_s == 4 * (10 * STEP_S + 3 * RESET_S)


def test_a_call_hangs_only_if_it_takes_half_of_the_time_that_was_left_and_much_longer_than_all_others() -> None:
    assert not hangs(now_s=119.0, called_s=100.0, deadline_s=140.0, slowest_s=0.1)
    assert hangs(now_s=122.0, called_s=100.0, deadline_s=140.0, slowest_s=0.1)
    assert not hangs(now_s=122.0, called_s=100.0, deadline_s=140.0, slowest_s=60.0)
    assert hangs(now_s=122.0, called_s=100.0, deadline_s=140.0, slowest_s=7.0)
    assert not hangs(now_s=137.0, called_s=136.0, deadline_s=140.0, slowest_s=0.1)  # the call has just begun


def test_copies_that_fail_early_are_stepped_again_if_at_least_half_of_the_time_stays_for_others() -> None:
    early = Tries((session(1, 10, CRASH, stepped_s=1.0),), None)  # it took 0.5 s to start
    assert early.need_another(seconds=6.0, left_s=12.0)
    assert not early.need_another(seconds=6.0, left_s=10.0)
    assert not early.need_another(seconds=2.0, left_s=60.0), "half of the steps were made"
    assert not Tries((session(1, 10, stepped_s=1.0),), None).need_another(seconds=6.0, left_s=60.0), "nothing was wrong"
    assert not Tries(early.sessions * TRIES, None).need_another(seconds=60.0, left_s=600.0)


def test_all_sessions_in_which_all_copies_were_stepped_are_measured_together() -> None:
    tries = Tries((session(2, 10, CRASH), session(2, 1, CRASH), session(2, 30)), ALONE)
    assert [len(each.steps) for each in tries.times] == [10, 10, 30, 30]
    assert [len(each.steps) for each in Tries((session(1, 1, CRASH), session(1, 2, CRASH)), None).times] == [2]


def test_if_there_is_no_time_for_a_second_try_the_finding_says_so() -> None:
    tries = Tries((session(4, 0, CRASH), session(4, 0, cut_off=True)), ALONE)
    assert tries.show_a_limit
    assert "(there was no time for a second try)" in tries.finding(ENOUGH_S)


def test_copies_for_which_the_time_is_up_neither_worked_nor_failed() -> None:
    tries = Tries((session(4, 1, cut_off=True),), ALONE)
    assert not tries.show_a_limit
    assert not tries.worked
    assert tries.were_cut_off
    assert tries.finding(ENOUGH_S).startswith("4 copies side by side were not measured")
    assert tries.finding(ENOUGH_S).endswith("allow more time with --seconds 1620")
    assert Failures.of([tries]).finding == ""


def test_two_copies_in_one_worker_are_tried_unless_the_result_is_known() -> None:
    assert Tries((session(2, 0, CRASH),), ALONE).decide_about_two
    assert Tries((session(1, 50, each=8),), ALONE).decide_about_two
    assert Tries((session(1, 50, CRASH, each=8),), ALONE).decide_about_two
    assert not Tries((session(1, 0, CRASH, each=8),), ALONE).decide_about_two
    assert not Tries((session(2, 50, CRASH),), ALONE).decide_about_two
