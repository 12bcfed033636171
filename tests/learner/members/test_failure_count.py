"""Which failures end a run, and which do not: the table of docs/explanation/faults.md."""

from __future__ import annotations

import pytest

from millrace.learner.members.events import EnvironmentRaised, Failed, PolicyRaised
from millrace.learner.members.failure_count import HOUR_S, MOST_IN_A_ROW, FailureCount
from millrace.protocol.errors import EnvironmentFailed, PolicyFailed, RunError

COPIES = 16  # of one lane each
TWO_HOURS_S = 2 * HOUR_S


def fails(count: FailureCount, times: int, *lanes: int | str, every_s: float = 0.0, worked_s: float | None = None) -> str:
    """These lanes fail so many times in a row. Returns why the last one ends the run; none before it does."""
    whys = [count.failed(lanes, worked_s, n * every_s) for n in range(times)]
    assert not any(whys[:-1])
    return whys[-1]


def crashes_and_collects(count: FailureCount, hours: float, every_s: float) -> float | None:
    """In turn, each copy collects and crashes. Returns the second at which that ends the run."""
    for n in range(int(hours * HOUR_S / every_s)):
        count.collected(n % COPIES)
        if count.failed((n % COPIES,), 0.0, n * every_s):
            return n * every_s
    return None


def test_sixteen_copies_that_each_crash_once_in_two_hours_do_not_end_the_run() -> None:
    assert crashes_and_collects(FailureCount(3, COPIES), 200.0, TWO_HOURS_S / COPIES) is None


def test_sixteen_copies_that_crash_at_the_same_moment_every_two_hours_do_not_end_it() -> None:
    count = FailureCount(3, COPIES)
    for hours in range(2, 200, 2):
        for lane in range(COPIES):
            count.collected(lane)
            assert count.failed((lane,), 0.0, hours * HOUR_S) == ""


@pytest.mark.parametrize(("allowed", "last"), [(0, 1), (3, 4), (MOST_IN_A_ROW, 11), (1_000, 11)])
def test_a_copy_that_crashes_at_each_reset_ends_it_soon_however_many_failures_are_allowed(allowed: int, last: int) -> None:
    why = fails(FailureCount(allowed, COPIES), last, 5)
    assert why == f"failure {last} in a row; max_env_failures allows {last - 1} in a row"


def test_only_failures_after_env_steps_are_told_that_shorter_rollouts_may_help() -> None:
    count = FailureCount(3, COPIES)
    assert fails(count, 1, 5, worked_s=0.0) == ""
    assert (
        fails(count, 3, 5)
        == "failure 3.25 in a row (one after env steps counts as 0.25); max_env_failures allows 3 in a row"
    )


def test_rollouts_of_other_lanes_do_not_excuse_a_copy_that_crashes_at_each_reset() -> None:
    count = FailureCount(3, COPIES)
    for _ in range(3):
        assert count.failed((5,), None, 0.0) == ""
        for lane in range(5):
            count.collected(lane)
    assert count.failed((5,), None, 0.0) != ""


def test_a_difficult_start_of_each_copy_does_not_end_it() -> None:
    count = FailureCount(3, COPIES)
    for lane in range(COPIES):
        assert fails(count, 3, lane) == ""


@pytest.mark.parametrize("worked_s", [None, 0.0], ids=["within a heartbeat", "after one"])
def test_a_mistake_that_strikes_after_a_few_steps_ends_a_run_that_has_just_begun(worked_s: float | None) -> None:
    count = FailureCount(3, COPIES)
    whys = [count.failed((n % 2,), worked_s, 5.0 * n) for n in range(7)]  # two workers, each with a lane
    assert any(whys)


def test_a_mistake_at_the_end_of_each_episode_ends_such_a_run_although_rollouts_arrive() -> None:
    assert crashes_and_collects(FailureCount(3, COPIES), 1.0, every_s=5.0) == 15.0


@pytest.mark.parametrize(("allowed", "last"), [(3, 13), (MOST_IN_A_ROW, 41), (1_000, 41)])
def test_failures_after_steps_with_never_a_rollout_between_end_also_an_old_run(allowed: int, last: int) -> None:
    """By chance, a simulator that dies in one rollout of two loses 13 in a row about once in 8,000 rollouts."""
    why = fails(FailureCount(allowed, COPIES), last, 5, every_s=HOUR_S, worked_s=0.0)
    assert why.startswith(f"failure {last / 4:g} in a row (one after env steps counts as 0.25; shorter rollouts may")


def test_a_simulator_that_dies_after_every_few_rollouts_trains_to_the_end_if_so_many_failures_are_allowed() -> None:
    every_s = 2.0  # 1800 failures an hour
    assert crashes_and_collects(FailureCount(105, COPIES), 10.0, every_s) is not None  # 105 and 16 times 105 are 1785
    assert crashes_and_collects(FailureCount(106, COPIES), 2.5, every_s) is None  # after an hour, each turn is the same


def test_failures_within_an_hour_are_allowed_in_proportion_to_copies_and_hours() -> None:
    count = FailureCount(2, 8, began_s=100.0)
    for lane in range(6):
        assert count.failed((lane,), 0.0, 100.0 + HOUR_S / 4) == ""
    why = count.failed((6,), 0.0, 100.0 + HOUR_S / 4)
    work = "as many for each 30 s that the workers which failed had worked"
    more = f"2, {work}, and as many an hour for each of 8 env copies; set it higher if need be"
    assert why == f"failure 7 within an hour; max_env_failures allows 6 ({more})"


@pytest.mark.parametrize(("works_s", "ends"), [(25.0, False), (11.0, False), (5.0, True)])
def test_a_simulator_that_crashes_now_and_then_ends_a_new_run_only_if_it_works_for_less_than_ten_seconds_between(
    works_s: float, ends: bool
) -> None:
    count, copies, workers = FailureCount(3, 8), 8, 4
    whys = []
    for n in range(400):
        count.collected(n % copies)
        whys.append(count.failed((n % copies,), works_s, (n + 1) * works_s / workers))
    assert any(whys) == ends


def test_work_counts_only_as_long_as_the_failure_after_it() -> None:
    count = FailureCount(1, 0)
    assert count.failed((0,), 10 * HOUR_S, 0.0) == "", "pays for 120 failures, since no more than an hour counts"
    for lane in range(1, 121):
        assert count.failed((lane,), 0.0, HOUR_S - 1.0) == ""
    assert "failure 122 within an hour; max_env_failures allows 121 " in count.failed((121,), 0.0, HOUR_S - 1.0)
    count = FailureCount(1, 0)
    assert count.failed((0,), 10 * HOUR_S, 0.0) == ""
    assert count.failed((1,), 0.0, HOUR_S) == ""
    assert "failure 2 within an hour; max_env_failures allows 1 " in count.failed((2,), 0.0, HOUR_S)


def test_a_person_is_told_of_the_fourth_failure_and_whenever_their_number_has_doubled() -> None:
    count = FailureCount(3, 8)
    lines = []
    for n in range(17):
        count.collected(n % 8)
        event = EnvironmentRaised("w0", "host", "boom", "", (n % 8,), worked_s=25.0)
        lines.append(count.count(event, 100.0 + 25.0 * n))
    count.check()
    assert [n + 1 for n, line in enumerate(lines) if line] == [4, 8, 16]
    assert lines[3] == (
        "the environment has failed 4 times in 75 s, after 25 s of work on average; its workers are started again, and "
        "failure 15 within an hour would end the run"
    )
    later_s = 3 * HOUR_S
    for n in range(4):
        event = EnvironmentRaised("w0", "host", "boom", "", (n,), worked_s=25.0)
        lines.append(count.count(event, later_s + n))
    assert [bool(line) for line in lines[17:]] == [False, False, False, True], "it is told again when they have become few"


def test_at_most_an_hour_counts_however_long_the_learner_has_run() -> None:
    count = FailureCount(2, 3)
    whys = [count.failed((lane,), 0.0, 99 * HOUR_S) for lane in range(9)]
    assert not any(whys[:-1])
    assert "failure 9 within an hour; max_env_failures allows 8 " in whys[-1]


def test_a_machine_on_which_nothing_works_does_not_end_it_while_its_lanes_work_elsewhere() -> None:
    count = FailureCount(3, COPIES)
    for n in range(1_000):
        assert count.failed((n % COPIES,), None, 30.0 * n) == ""
        count.collected(n % COPIES)


def test_a_failure_that_takes_eight_lanes_down_counts_once() -> None:
    count = FailureCount(3, COPIES)
    assert fails(count, 3, *range(8), worked_s=0.0) == ""
    assert fails(count, 1, *range(8), worked_s=0.0).startswith("failure 4 within an hour")


def test_episodes_of_an_evaluation_show_that_the_copies_work() -> None:
    count = FailureCount(3, COPIES)
    for _ in range(10):
        assert fails(count, 3, 0, 1) == ""
        count.evaluated()
    assert fails(count, 4, 0, 1) != ""


def test_each_worker_that_describes_the_environment_is_counted_by_its_name() -> None:
    count = FailureCount(3)
    assert {fails(count, 3, f"w{n}") for n in range(16)} == {""}
    assert fails(count, 1, "w5") == "failure 4 in a row; max_env_failures allows 3 in a row"
    count = FailureCount(1)
    for n in range(16):
        count.count(EnvironmentRaised(f"w{n}", "host", "boom", ""), 0.0)
    count.check()


@pytest.mark.parametrize(("event", "error"), [(EnvironmentRaised, EnvironmentFailed), (PolicyRaised, PolicyFailed)])
def test_the_error_says_what_has_failed_and_where(event: type[Failed], error: type[RunError]) -> None:
    count = FailureCount(0)
    for lane in range(2):
        count.count(event("w0", "box", f"boom {lane}", "its traceback", (lane,)), 0.0)
    with pytest.raises(error, match=r"^worker w0 \(box\): boom 0; failure 1 in a row; ") as raised:
        count.check()
    assert raised.type is error
