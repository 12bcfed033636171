"""What a plan says apart from its settings, by measurements that nobody made."""

from __future__ import annotations

import pytest

from millrace.planning.advice import about_measurements
from millrace.planning.expected_rate import Sizes
from millrace.planning.measurements import Machine
from tests.millrace.planning.made_up import chosen, measured, rate, situation


def lines(agents: int) -> list[str]:
    where = situation(measured(wait_s=0.01, reset_s=5.0, episode_steps=100.0, goals=True, copies_worked=16, agents=agents))
    return about_measurements(chosen(where), where, rate)


def test_a_wrapper_of_gymnasium_and_hindsight_are_advised_only_for_one_agent() -> None:
    resets, goals = lines(agents=1)
    assert "--wrappers millrace:ResetAhead" in resets
    assert "--hindsight" in goals
    assert lines(agents=2) == []


@pytest.mark.parametrize(("episode_steps", "reset_s", "says"), [(None, 2.0, True), (None, 1e-3, False), (40.0, 2.0, False)])
def test_if_no_episode_has_ended_a_line_says_that_slow_resets_are_not_counted(
    episode_steps: float | None, reset_s: float, says: bool
) -> None:
    where = situation(measured(wait_s=0.01, reset_s=reset_s, episode_steps=episode_steps, copies_worked=16))
    found = about_measurements(chosen(where), where, rate)
    assert any("doesn't count them, because no episode has ended" in line for line in found) == says


@pytest.mark.parametrize(("most_copies", "advised"), [(0, True), (4, True), (3, False), (2, False)])
def test_resets_ahead_are_advised_only_if_two_environments_for_each_copy_are_allowed(
    most_copies: int, advised: bool
) -> None:
    machine = Machine(cores=2, free_bytes=16 << 30, most_copies=most_copies)
    where = situation(measured(wait_s=0.01, reset_s=5.0, episode_steps=100.0, copies_worked=16), machine=machine)
    sizes = Sizes(workers=2, envs=2, lanes=2, max_lag=0, rollout_steps=64)
    assert any("millrace:ResetAhead" in line for line in about_measurements(sizes, where, rate)) == advised
