"""Environments that raise or return invalid data: one line names lane, copy and step, and the detail has the traceback."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from protocol.errors import UsageError
from protocol.specs import RunSpec
from tests.support.collectors import (
    TOY,
    collect,
    loop_over,
    random_collector,
    run_around,
    run_of,
    sync_vector_env_over,
    with_env,
)
from workers.collect.env_copies import LoopedCopies
from workers.env_errors import LaneFailed
from workers.envs.toy import Countdown


def failure_of(run: RunSpec, lanes: tuple[int, ...] = (2, 5)) -> LaneFailed:
    """The error of a collector on this run's environment."""
    with pytest.raises(LaneFailed) as caught:
        collect(random_collector(run), run, lanes=lanes)
    assert "\n" not in str(caught.value)
    return caught.value


def test_an_environment_that_raises_is_named_with_its_own_traceback() -> None:
    error = failure_of(run_of(f"{TOY}Raises-v0", N=3, kwargs={"after": 3}))
    assert (
        str(error) == "lane 2, copy 0, step 3: its environment raised ValueError: the toy is broken, as it was asked to be"
    )
    assert error.lane == 2
    assert 'raise ValueError("the toy is broken, as it was asked to be")' in error.detail
    assert "toy.py" in error.detail


def test_the_lane_and_copy_that_raise_are_named() -> None:
    class Third(Countdown):
        def reset(self, **keywords: Any) -> tuple[Any, dict[str, Any]]:
            raise OSError("no display")

    run = run_of(f"{TOY}Countdown-v0", N=3)
    with pytest.raises(LaneFailed, match="lane 5, copy 2, first reset: its environment raised OSError: no display"):
        collect(random_collector(run, loop_over([Countdown, Countdown, Third])), run, lanes=(5,))


def test_an_environment_that_fails_once_works_again_in_a_new_incarnation(tmp_path: Path) -> None:
    run = run_of(f"{TOY}Raises-v0", kwargs={"once": str(tmp_path / "broke")})
    collector = random_collector(run)
    with pytest.raises(LaneFailed):
        collect(collector, run)
    collect(collector, run, incarnation=1)


def test_an_environment_that_cannot_be_made_is_named() -> None:
    def make() -> gymnasium.Env[Any, Any]:
        raise RuntimeError("no licence\nfound")

    run = run_of(f"{TOY}Countdown-v0")
    with pytest.raises(LaneFailed, match=r"lane 0, copy 0, made: .* RuntimeError: no licence$"):
        collect(random_collector(run, lambda r, lane, pulse: LoopedCopies([make] * 2, pulse)), run)


def test_a_vector_environment_that_raises_is_named() -> None:
    run = run_of(f"{TOY}Raises-v0", N=2)
    with pytest.raises(LaneFailed, match="lane 0, step 3: its environment raised ValueError: the toy"):
        collect(random_collector(run, sync_vector_env_over([run.env.make] * 2)), run)


def test_a_reward_that_is_not_finite_is_named() -> None:
    error = failure_of(run_of(f"{TOY}NaNReward-v0", N=1, kwargs={"after": 3}))
    assert str(error) == "lane 2, reward: expected finite values, got nan at step 3, copy 0"
    huge = failure_of(run_of(f"{TOY}Countdown-v0", N=1, kwargs={"reward": 1e300}))
    assert str(huge) == "lane 2, reward: expected finite values, got inf at step 0, copy 0"


def test_an_observation_that_is_not_finite_is_named() -> None:
    error = failure_of(run_of(f"{TOY}NaNObservation-v0", N=1, kwargs={"after": 3}))
    assert str(error) == "lane 2, observation: expected finite values, got nan at step 4, copy 0"


class Answers(Countdown):
    """Gives some good rows, then the one it is told to; after that it raises."""

    def __init__(self, good: int, observation: Any, reward: Any = 1.0, space: Any = None) -> None:
        super().__init__()
        self.observation_space = space or self.observation_space
        row, last = (self.observation_space.sample(), 1.0), (observation, reward)
        self._rows = iter([row] * good + [last])

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        return next(self._rows)[0], {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        for row in self._rows:
            return *row, False, False, {}
        raise AssertionError("what happens after such a row")


def answer(good: int, observation: Any, reward: Any = 1.0, space: Any = None) -> str:
    """What is said of an environment that answers this after `good` rows."""
    env = Answers(good, observation, reward, space)
    run = run_around(env, T=6)
    with pytest.raises(LaneFailed) as caught:
        collect(random_collector(run, loop_over([lambda: env])), run)
    return str(caught.value)


@pytest.mark.parametrize("good", [0, 1], ids=["reset", "step"])
@pytest.mark.parametrize(
    ("observation", "got"),
    [
        (np.zeros(2, np.float32), "float32[2]"),
        (np.float32(0), "float32[]"),
        (np.zeros((1, 1), np.float32), "float32[1, 1]"),
        (np.zeros(1, complex), "complex128[1]"),
        ("up", "<U2[]"),
        (None, "object[]"),
        ([[1, 2], [3]], "object[]"),
    ],
    ids=str,
)
def test_an_observation_that_does_not_fit_is_refused_before_it_is_kept(good: int, observation: Any, got: str) -> None:
    when = ["first reset", "step 0"][good]
    assert answer(good, observation).startswith(
        f"lane 0, copy 0, {when}: observation: expected float32[1] as its space says, got {got}; fix"
    )


@pytest.mark.parametrize(
    ("space", "observation"),
    [
        (gymnasium.spaces.Box(0, 255, (2,), np.uint8), np.array([0.5, 0.5])),
        (gymnasium.spaces.Box(0, 255, (2,), np.uint8), np.array([256, 0])),
        (gymnasium.spaces.Box(-9, 9, (2,), np.int16), np.array([70000, 0])),
        (gymnasium.spaces.Discrete(3), 1.0),
    ],
    ids=str,
)
def test_an_observation_that_would_lose_its_meaning_is_refused(space: Any, observation: Any) -> None:
    assert "as its space says" in answer(0, observation, space=space)


class Doubles(Countdown):
    """Says float32 and gives float64, as many do."""

    def _observation(self) -> Any:
        return np.array([0.1])


def test_a_float_may_lose_precision() -> None:
    run = run_of(f"{TOY}Countdown-v0", N=1)
    (rollout,) = collect(random_collector(run, loop_over([Doubles])), run)
    assert (rollout.obs[0] == np.float32(0.1)).all()


@pytest.mark.parametrize("observation", [3, -1])
def test_a_discrete_observation_outside_its_space_is_named(observation: int) -> None:
    said = answer(3, observation, space=gymnasium.spaces.Discrete(3))
    assert said == f"lane 0, observation: expected a value of its space, got {observation} at step 3, copy 0"


@pytest.mark.parametrize(
    ("reward", "said"),
    [
        (
            "much",
            "step 2: its environment returned an unusable value: could not convert string to float: 'much'",
        ),
        ([1.0, 2.0], "step 2: its environment returned an unusable value: setting an array element"),
        (None, "reward: expected finite values, got nan at step 2, copy 0"),
    ],
)
def test_a_reward_that_is_no_number_is_refused(reward: Any, said: str) -> None:
    assert answer(3, np.zeros(1, np.float32), reward).startswith(f"lane 0, {said}")


def test_a_nan_is_named_even_if_the_environment_then_chokes_on_it() -> None:
    said = answer(3, np.full(1, np.nan, np.float32))
    assert said == "lane 0, observation: expected finite values, got nan at step 3, copy 0"
    assert "what happens after such a row" in answer(3, np.zeros(1, np.float32))


def test_an_environment_of_another_version_is_refused() -> None:
    run = with_env(run_of("CartPole-v1"), "Acrobot-v1")
    with pytest.raises(UsageError, match=r"environment Acrobot-v1: its observations .* are not what the learner has"):
        collect(random_collector(run), run)
