"""The wrapper that notes how long a copy takes, and what is read of its notes."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from millrace.planning.stand_in import StandIn, StandInOfAgents, shown
from millrace.planning.stopwatch import read_notes, stopwatch
from millrace.protocol.envs.seats import seated
from tests.support.envs.toy import Scripted


@pytest.fixture
def notes(tmp_path: Path) -> Path:
    """An empty folder."""
    folder = tmp_path / "notes"
    folder.mkdir()
    return folder


class Busy(Scripted):
    """Keeps its core busy for 2 ms in each step."""

    def step(self, action: Any) -> Any:
        end_s = time.process_time() + 0.002
        while time.process_time() < end_s:
            pass
        return super().step(action)


class Raises(Scripted):
    """Raises at its third step."""

    def step(self, action: Any) -> Any:
        answer = super().step(action)
        if self._steps == 3:
            raise ValueError("broken")
        return answer


def test_it_changes_nothing_and_notes_each_call(notes: Path) -> None:
    plain = Scripted("..t")
    timed = stopwatch(Scripted("..t"), str(notes))
    assert data_equivalence(plain.reset(seed=1), timed.reset(seed=1))
    for _ in range(3):
        assert data_equivalence(plain.step(0), timed.step(0))
    timed.reset()
    timed.close()
    (found,) = read_notes(notes)
    assert (len(found.steps), len(found.resets)) == (3, 2)
    assert found.resets[0, 0] < found.steps[0, 0] < found.steps[2, 0] < found.resets[1, 0]  # in their order
    assert found.bytes > 10 << 20  # this process has imported numpy


def test_cpu_time_is_told_from_waiting(notes: Path) -> None:
    timed = stopwatch(Busy(), str(notes))
    timed.reset()
    for _ in range(5):
        timed.step(0)
    timed.close()
    (found,) = read_notes(notes)
    # CPU time and the time in which this thread had no core make up the wall time; the clocks are read one after another.
    wall_s, cpu_s, delay_s = found.steps[:, 1:].T
    assert (cpu_s >= 0.002).all()
    assert np.median(wall_s - cpu_s - delay_s) < 0.001


def test_notes_of_a_copy_that_crashes_are_kept(notes: Path) -> None:
    timed = stopwatch(Raises("....."), str(notes))
    timed.reset()
    timed.step(0)
    timed.step(0)
    with pytest.raises(ValueError, match="broken"):
        timed.step(0)
    (found,) = read_notes(notes)  # it was not closed
    assert (len(found.resets), len(found.steps)) == (1, 3)
    (path,) = notes.iterdir()
    os.truncate(path, path.stat().st_size - 3)  # the last note was cut off
    (found,) = read_notes(notes)
    assert (len(found.resets), len(found.steps)) == (1, 2)
    timed.close()


def test_agents_are_timed_too_and_a_stand_in_has_their_spaces(notes: Path) -> None:
    spaces: tuple[gymnasium.Space[Any], gymnasium.Space[Any]] = (
        gymnasium.spaces.Box(-1, 1, (3,)),
        gymnasium.spaces.Discrete(2),
    )
    env = seated(stopwatch(StandInOfAgents(*spaces, agents=("a", "b")), str(notes)), "stand-in")
    assert env.seats == ("a", "b")
    found_spaces: tuple[gymnasium.Space[Any], gymnasium.Space[Any]] = (env.observation_space, env.action_space)
    assert found_spaces == spaces
    env.reset(seed=1)
    env.close()
    (found,) = read_notes(notes)
    assert len(found.resets) == 1


def test_a_stand_in_never_ends_and_allows_every_action() -> None:
    masked = gymnasium.spaces.Dict({"x": gymnasium.spaces.Box(-1, 1, (3,)), "action_mask": gymnasium.spaces.MultiBinary(4)})
    assert shown(masked)["action_mask"].all()
    env = StandIn(masked, gymnasium.spaces.Discrete(4))
    observation, _ = env.reset(seed=1)
    assert masked.contains(observation)
    assert env.step(3)[2:4] == (False, False)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize(("low", "high"), [(-math.inf, math.inf), (None, None), (0.0, None), (-0.25, 0.25), (100.0, 1e4)])
def test_a_stand_in_shows_small_numbers_of_its_space_whatever_its_bounds(
    dtype: Any, low: float | None, high: float | None
) -> None:
    """A bound of None is the largest number of the dtype."""
    largest = float(np.finfo(dtype).max)
    box = gymnasium.spaces.Box(-largest if low is None else low, largest if high is None else high, (50,), dtype)
    space = gymnasium.spaces.Dict({"x": gymnasium.spaces.Tuple([box, gymnasium.spaces.Discrete(3, start=5)])})
    found = shown(space)
    assert space.contains(found)
    numbers = found["x"][0].tolist()
    assert max(map(abs, numbers)) <= (101.0 if low == 100.0 else 1.0)
    assert len(set(numbers)) > 10


def test_a_stand_in_allows_every_action_if_its_mask_has_parts() -> None:
    bits = gymnasium.spaces.Tuple([gymnasium.spaces.MultiBinary(3), gymnasium.spaces.Discrete(2)])
    masked = gymnasium.spaces.Dict({"action_mask": bits, "x": gymnasium.spaces.Box(-1, 1, (3,))})
    first, second = shown(masked)["action_mask"]
    assert first.tolist() == [1, 1, 1]
    assert second == 1
    assert masked.contains(shown(masked))


def test_its_rewards_are_the_cpu_time_of_the_worker_whichever_of_its_copies_is_stepped() -> None:
    spaces = gymnasium.spaces.Box(-1, 1, (3,)), gymnasium.spaces.Discrete(4)
    copies = StandIn(*spaces), StandIn(*spaces, wait_s=0.005)
    copies[0].step(0)
    began_s = time.process_time()
    end_s = began_s + 0.003
    while time.process_time() < end_s:
        pass
    rewards = [copy.step(0)[1] for copy in copies]
    took_s = time.process_time() - began_s
    assert sum(rewards) >= 0.003
    assert sum(rewards) < took_s + 0.001  # the first counts from the step before `began_s`
    assert rewards[1] < 0.002  # it waited for 5 ms
