"""The queueing model: what it says of rounds whose times are known, and what no run can exceed."""

from __future__ import annotations

import itertools

import msgspec
import pytest

from millrace.planning.expected_rate import Sizes
from millrace.planning.measurements import Machine
from tests.millrace.planning.made_up import MACHINE, NO_OVERHEADS, OVERHEADS, measured, rate, situation


def sizes(workers: int, lag: int, *, envs: int = 16, lanes: int = 16, steps: int = 10) -> Sizes:
    return Sizes(workers=workers, envs=envs, lanes=lanes, max_lag=lag, rollout_steps=steps)


SLACK = 1.03  # where waiting and computing are alike, the model adds a little; here computing is a hundredth at most


@pytest.mark.parametrize("workers", [1, 4, 16])
def test_workers_that_only_wait_make_a_step_of_each_copy_one_after_another(workers: int) -> None:
    where = situation(measured(wait_s=0.01, cpu_s=0), NO_OVERHEADS)
    assert rate(sizes(workers, 0), where) == pytest.approx(workers / 0.01)
    assert rate(sizes(workers, 1), where) == pytest.approx(workers / 0.01)


def test_if_lanes_do_not_divide_among_workers_all_wait_for_the_one_that_has_most() -> None:
    where = situation(measured(wait_s=0.01, cpu_s=0), NO_OVERHEADS)
    assert rate(sizes(5, 0), where) == pytest.approx(16 / (4 * 0.01))


def test_without_a_lag_updates_and_collecting_take_turns_and_with_one_the_longer_of_them_counts() -> None:
    slow_learner = msgspec.structs.replace(NO_OVERHEADS, update_s=0.002)
    where = situation(measured(wait_s=0.01, cpu_s=0), slow_learner)
    assert rate(sizes(16, 0), where) == pytest.approx(16 / (0.01 + 16 * 0.002))
    assert 1 / 0.002 / SLACK < rate(sizes(16, 1), where) <= 1 / 0.002 * (1 + 1e-9)


def test_steps_that_compute_are_no_faster_than_the_cores() -> None:
    where = situation(measured(cpu_s=0.01, tried=2), NO_OVERHEADS)
    two = rate(sizes(2, 0), where)
    assert two <= 2 / 0.01
    assert two > 0.8 * 2 / 0.01
    assert rate(sizes(16, 0), where) <= 2 / 0.01
    assert rate(sizes(16, 0), situation(measured(cpu_s=0.01, tried=2), NO_OVERHEADS, Machine(cores=16))) > 5 * two


def test_the_time_of_the_learner_bounds_every_run() -> None:
    """Whatever the environment, workers and lag."""
    for wait_s, lag, workers in itertools.product((0, 1e-3, 1e-1), (0, 1, 2), (1, 2, 16)):
        where = situation(measured(wait_s=wait_s, cpu_s=1e-5))
        assert rate(sizes(workers, lag), where) <= 1 / OVERHEADS.update_s * (1 + 1e-9)


def test_the_row_that_resets_a_copy_is_no_env_step() -> None:
    endless = situation(measured(wait_s=0.01, cpu_s=0), NO_OVERHEADS)
    short = situation(measured(wait_s=0.01, cpu_s=0, episode_steps=4.0, reset_s=0.0), NO_OVERHEADS)
    # A row that resets takes no time here, so env steps/s are the same. With a reset as long as a step, a fifth is lost.
    assert rate(sizes(16, 0, steps=1000), short) == pytest.approx(rate(sizes(16, 0, steps=1000), endless))
    slow = situation(measured(wait_s=0.01, cpu_s=0, episode_steps=4.0, reset_s=0.01), NO_OVERHEADS)
    alone = sizes(1, 0, envs=1, lanes=1, steps=10_000)
    assert rate(alone, slow) == pytest.approx(0.8 / 0.01, rel=0.02)  # 2,000 resets, whose number varies by 2 %


def test_uneven_steps_and_resets_cost_less_with_more_lag() -> None:
    uneven = situation(measured(wait_s=0.005, std_s=0.02, episode_steps=100.0, reset_s=0.3), NO_OVERHEADS)
    rates = [rate(sizes(16, lag), uneven) for lag in (0, 1, 2)]
    assert rates[0] < 0.95 * rates[1]
    assert rates[1] < rates[2]
    assert rates[2] <= 16 / (0.0051 + 0.003)  # copies that never wait for others


def test_resets_in_the_background_cost_nothing_if_an_episode_takes_longer() -> None:
    found = measured(wait_s=0.005, episode_steps=100.0, reset_s=0.3)
    plain = rate(sizes(16, 1), situation(found))
    ahead = rate(sizes(16, 1), situation(found, resets_ahead=True))
    never = rate(sizes(16, 1), situation(measured(wait_s=0.005, episode_steps=100.0, reset_s=0.0)))
    assert plain < 0.7 * ahead
    assert ahead == pytest.approx(never)


@pytest.mark.parametrize("lag", [0, 1, 2])
def test_more_machines_are_never_slower_and_never_faster_than_the_learner(lag: int) -> None:
    found = measured(cpu_s=0.01, tried=2)
    one = rate(sizes(2, lag), situation(found))
    ten = rate(sizes(20, lag, envs=160, lanes=160), situation(found, machines=10))
    assert 4 * one < ten <= 1 / OVERHEADS.update_s


def test_workers_that_were_never_tried_together_have_the_costs_of_the_most_that_were() -> None:
    slower_together = msgspec.structs.replace(
        measured(wait_s=0.01, cpu_s=0),
        side_by_side=(measured(wait_s=0.01, cpu_s=0).alone, measured(wait_s=0.04, cpu_s=0).side_by_side[-1]),
    )
    where = situation(slower_together, NO_OVERHEADS, MACHINE)
    assert rate(sizes(1, 0, envs=1, lanes=1), where) == pytest.approx(100)
    assert rate(sizes(32, 0, envs=32, lanes=32), where) == pytest.approx(32 / 0.04)
    # On two machines, 16 workers run side by side; on 16 machines each is alone.
    two = msgspec.structs.replace(where, machines=2)
    sixteen = msgspec.structs.replace(where, machines=16)
    assert rate(sizes(32, 0, envs=32, lanes=32), two) == pytest.approx(32 / 0.04)
    assert rate(sizes(16, 0), sixteen) == pytest.approx(16 / 0.01)


def test_a_round_waits_for_the_slowest_of_uneven_workers() -> None:
    """The mean of the largest of 16 normal numbers is 1.77 standard deviations above their mean."""
    uneven = situation(measured(wait_s=0.01, cpu_s=0, std_s=0.01), NO_OVERHEADS)
    steps = 100
    slowest_s = steps * 0.01 + 1.77 * 0.01 * steps**0.5
    # 50 rounds are counted; the largest of each varies by 0.54 of a standard deviation.
    assert rate(sizes(16, 0, steps=steps), uneven) == pytest.approx(16 * steps / slowest_s, rel=0.03)


def test_a_learner_shares_the_cores_with_workers_that_compute() -> None:
    """Two workers compute for 0.64 s, beside an update of 1.28 s: three processes at two thirds of the speed."""
    slow_learner = msgspec.structs.replace(NO_OVERHEADS, update_s=0.02)
    where = situation(measured(cpu_s=0.02, tried=2), slow_learner)
    shared = sizes(2, 1, envs=8, lanes=8, steps=8)
    assert rate(shared, where) == pytest.approx(64 / (0.64 * 1.5 + 0.64))
    one = sizes(1, 1, envs=8, lanes=8, steps=8)
    assert rate(one, where) > rate(shared, where)  # it leaves the learner a core


def test_time_without_a_core_is_neither_waiting_nor_computing() -> None:
    busy = msgspec.structs.replace(measured(cpu_s=0.002).alone, mean_s=0.01, delay_s=0.008)
    assert busy.wait_s == pytest.approx(0, abs=1e-12)
    assert busy.own_s == pytest.approx(0.002)
    assert busy.computes
