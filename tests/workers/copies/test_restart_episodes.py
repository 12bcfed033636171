"""Env copies that are made anew after some episodes: how often, and that nothing else changes.

`tests/workers/lanes/test_bring_back.py` compares their rollouts with those of copies that stay, bit for bit.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest

from millrace.protocol.envs.which_copy import FIRST_COPY
from millrace.protocol.wire.plain_values import pack
from millrace.workers.copies.env_copies import CopySettings, LoopedCopies
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.env_loop import EnvLoop
from millrace.workers.copies.looped_kind import loop_over
from millrace.workers.copy_slots import env_copy
from tests.support.in_process.collectors import no_pulse, run_around

ACTIONS = np.zeros(2, np.int64)
EPISODE = 2
"""rows of an episode, with the one that resets the copy"""


class OneStep(gymnasium.Env[Any, Any]):
    """Episodes of one step that show what `np_random` draws, and the attribute `level`."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Discrete(2)
    level = 0.0

    def __init__(self, made: list[OneStep]) -> None:
        self.which = env_copy()
        self.resets: list[int | None] = []
        self.closed = False
        made.append(self)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.resets.append(seed)
        return self._shown(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._shown(), 0.0, True, False, {}

    def close(self) -> None:
        assert not self.closed
        self.closed = True

    def _shown(self) -> Any:
        return np.array([self.np_random.random(), self.level])


class Unreadable(OneStep):
    """It draws from a generator that nobody can read."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.resets.append(seed)
        return self._shown(), {}

    def _shown(self) -> Any:
        return np.zeros(2)


def copies_of(made: list[OneStep], restart_episodes: int, kind: type[OneStep] = OneStep) -> LoopedCopies:
    copies = LoopedCopies([lambda: kind(made)] * 2, no_pulse, CopySettings(restart_episodes=restart_episodes))
    copies.reset([3, 4], no_pulse)
    return copies


def played(copies: LoopedCopies, episodes: int) -> list[list[float]]:
    """What both copies show in these episodes."""
    shown = []
    for _ in range(episodes * EPISODE):
        (leaf,) = copies.step(ACTIONS, no_pulse).leaves
        shown.append(np.concatenate(leaf).tolist())
    return shown


@pytest.mark.parametrize("episodes", [1, 3])
def test_each_copy_is_made_anew_after_so_many_episodes(episodes: int) -> None:
    made: list[OneStep] = []
    copies = copies_of(made, episodes)
    played(copies, 6)
    assert len(made) == 2 * (1 + 6 // episodes)
    assert [env.closed for env in made] == [True] * (len(made) - 2) + [False] * 2
    assert [env.which.copy for env in made] == [0, 1] * (len(made) // 2)
    assert {env.resets[0] for env in made if env.which.copy == 0} == {3}, "each begins with the seed of its start"
    copies.close()


def test_the_copies_of_a_run_are_made_anew_after_as_many_episodes_as_it_says() -> None:
    made: list[OneStep] = []
    run = msgspec.structs.replace(run_around(OneStep([]), T=1), restart_episodes=3)
    copies = loop_over(run, lambda: OneStep(made), 2, FIRST_COPY, no_pulse)
    copies.reset([3, 4], no_pulse)
    played(copies, 6)
    assert len(made) == 2 * (1 + 6 // 3)
    copies.close()


@pytest.mark.parametrize("episodes", [1, 2])
def test_a_new_copy_goes_on_as_the_old_one_with_its_attributes(episodes: int) -> None:
    def shown(restart_episodes: int) -> list[list[float]]:
        copies = copies_of([], restart_episodes)
        first = played(copies, 3)
        copies.assign("level", pack(7.0), no_pulse)
        return first + played(copies, 4)

    kept = shown(0)
    assert shown(episodes) == kept
    assert kept[-1][1] == 7.0
    assert len({tuple(each) for each in kept}) == len(kept), "episodes cannot be told from each other"


class Grows(OneStep):
    """Its level rises with each episode, and is part of the state that it can save."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.level += 1
        return super().reset(seed=seed)

    def save_state(self) -> bytes:
        return bytes([int(self.level)])

    def load_state(self, state: bytes) -> None:
        (self.level,) = state


class ReturnsNoBytes(Grows):
    """Its state can't be saved."""

    def save_state(self) -> Any:
        return None


@pytest.mark.parametrize("episodes", [1, 2])
def test_a_new_copy_has_the_state_that_the_old_one_saved(episodes: int) -> None:
    made: list[OneStep] = []
    assert played(copies_of(made, episodes, Grows), 5) == played(copies_of([], 0, Grows), 5)
    assert len(made) > 2


def test_a_copy_whose_state_cannot_be_saved_is_made_anew_with_its_random_numbers_alone() -> None:
    made: list[OneStep] = []
    shown = played(copies_of(made, 1, ReturnsNoBytes), 2)
    assert [row[0] for row in shown] == [row[0] for row in played(copies_of([], 0, OneStep), 2)]
    assert len(made) == 6


def test_a_copy_whose_random_numbers_cannot_be_read_stays_and_whoever_trains_is_told() -> None:
    made: list[OneStep] = []
    copies = copies_of(made, 1, Unreadable)
    played(copies, 3)
    assert len(made) == 2
    assert "super().reset(seed=seed)" in copies.note
    assert copies_of([], 1).note == ""
    assert copies_of([], 0, Unreadable).note == ""


def test_copies_of_an_evaluation_are_made_anew_too_and_reset_with_the_seed_alone() -> None:
    made: list[OneStep] = []
    loop = EnvLoop([lambda: Unreadable(made)], no_pulse, "Disabled", restart_episodes=2)
    for seed in range(5):
        loop.reset([0], [seed], [None], no_pulse)
    assert [env.resets for env in made] == [[0, 1], [2, 3], [4]]


def test_a_copy_that_cannot_be_made_anew_is_a_failure_of_it() -> None:
    made: list[OneStep] = []

    def make() -> OneStep:
        if made:
            raise OSError("no licence")
        return OneStep(made)

    copies = LoopedCopies([make], no_pulse, CopySettings(restart_episodes=1))
    copies.reset([1], no_pulse)
    copies.step(ACTIONS[:1], no_pulse)
    with pytest.raises(CopyFailed) as caught:
        copies.step(ACTIONS[:1], no_pulse)
    assert caught.value.copy == 0
    assert isinstance(caught.value.__cause__, OSError)
