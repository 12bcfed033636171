"""Environments that raise or return invalid data: one line names lane, copy and step, and the detail has the traceback."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from millrace.extras.envs.vector_copies import VectorCopies
from millrace.protocol.arrays import Array
from millrace.protocol.errors import EnvironmentFailed, UsageError
from millrace.protocol.specs import RunSpec
from millrace.workers.copies.env_copies import LoopedCopies
from tests.support.envs.toy import Countdown
from tests.support.in_process.collectors import (
    TOY,
    bits,
    collect,
    loop_over,
    random_collector,
    run_around,
    run_of,
    sync_vector_env_over,
    with_env,
)


def failure_of(run: RunSpec, lanes: tuple[int, ...] = (2, 5)) -> EnvironmentFailed:
    """The error of a collector on this run's environment."""
    with pytest.raises(EnvironmentFailed) as caught:
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


class WantsAnInt(Countdown):
    def step(self, action: Any) -> Any:
        assert isinstance(action, int), "no move"
        return super().step(action)


class NamesIt(Countdown):
    def step(self, action: Any) -> Any:
        raise KeyError(f"no move {action!r}")


@pytest.mark.parametrize("made", [WantsAnInt, NamesIt])
def test_an_environment_that_wants_an_int_of_python_is_told_what_it_gets(made: type[Countdown]) -> None:
    """As gymnasium's vector environments pass actions, and `Discrete.sample` draws them."""
    run = run_of(f"{TOY}Countdown-v0", N=3)
    with pytest.raises(EnvironmentFailed, match="its action is a numpy integer: write int\\(action\\) there"):
        collect(random_collector(run, loop_over([Countdown, Countdown, made])), run, lanes=(5,))


def test_the_lane_and_copy_that_raise_are_named() -> None:
    class Third(Countdown):
        def reset(self, **keywords: Any) -> tuple[Any, dict[str, Any]]:
            raise OSError("no display")

    run = run_of(f"{TOY}Countdown-v0", N=3)
    with pytest.raises(EnvironmentFailed, match="lane 5, copy 2, first reset: its environment raised OSError: no display"):
        collect(random_collector(run, loop_over([Countdown, Countdown, Third])), run, lanes=(5,))


def test_an_environment_that_fails_once_works_again_in_a_new_incarnation(tmp_path: Path) -> None:
    run = run_of(f"{TOY}Raises-v0", kwargs={"once": str(tmp_path / "broke")})
    collector = random_collector(run)
    with pytest.raises(EnvironmentFailed):
        collect(collector, run)
    collect(collector, run, incarnation=1)


def test_an_environment_that_cannot_be_made_is_named() -> None:
    def make() -> gymnasium.Env[Any, Any]:
        raise RuntimeError("no licence\nfound")

    run = run_of(f"{TOY}Countdown-v0")
    with pytest.raises(EnvironmentFailed, match=r"lane 0, copy 0, made: .* RuntimeError: no licence$"):
        collect(random_collector(run, lambda r, lane, pulse: LoopedCopies([make] * 2, pulse)), run)


def test_a_vector_environment_that_raises_is_named() -> None:
    run = run_of(f"{TOY}Raises-v0", N=2)
    with pytest.raises(EnvironmentFailed, match="lane 0, step 3: its environment raised ValueError: the toy"):
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
    with pytest.raises(EnvironmentFailed) as caught:
        collect(random_collector(run, loop_over([lambda: env])), run)
    return str(caught.value)


@pytest.mark.parametrize("good", [0, 1, 4], ids=["reset", "first step", "later step"])
@pytest.mark.parametrize(
    ("observation", "got"),
    [
        (np.zeros(2, np.float32), "float32[2]"),
        (np.float32(0), "float32[]"),
        (np.zeros((1, 1), np.float32), "float32[1, 1]"),
        (np.zeros(1, complex), "complex128[1]"),
        ("up", "<U2[]"),
        (None, "object[]"),
        ("1", "<U1[]"),
        (["1"], "<U1[1]"),
        ([None], "object[1]"),
        ([[1, 2], [3]], "object[]"),
    ],
    ids=str,
)
def test_an_observation_that_does_not_fit_is_refused_before_it_is_kept(good: int, observation: Any, got: str) -> None:
    when = f"step {good - 1}" if good else "first reset"
    assert answer(good, observation).startswith(
        f"lane 0, copy 0, {when}: observation: expected float32[1] as its space says, got {got}; fix"
    )


class NoArray:
    """Raises where it is to become an array, as a tensor that requires a gradient."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("call detach()\nfirst")


@pytest.mark.parametrize("shape", [(1,), ()], ids=str)
@pytest.mark.parametrize("good", [0, 1, 4], ids=["reset", "first step", "later step"])
def test_an_observation_that_numpy_cannot_read_is_named_with_its_copy(good: int, shape: tuple[int, ...]) -> None:
    said = answer(good, NoArray(), space=gymnasium.spaces.Box(-1, 1, shape, np.float32))
    when = f"step {good - 1}" if good else "first reset"
    got = "a NoArray that numpy cannot read: call detach()"
    assert said == f"lane 0, copy 0, {when}: observation: expected an array, got {got}"


def test_an_exception_without_a_text_is_said_to_have_none() -> None:
    class Stops(Countdown):
        def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
            raise StopIteration

    run = run_around(Stops(), T=6)
    with pytest.raises(EnvironmentFailed, match=r"step 0: its environment raised StopIteration: no message$"):
        collect(random_collector(run, loop_over([Stops])), run)


class NoNumber:
    """Raises where it is to become a number."""

    def __float__(self) -> float:
        raise RuntimeError("no number")

    def __repr__(self) -> str:
        return "<no number>"


@pytest.mark.parametrize(("reward", "got"), [(10**400, "1000"), (NoNumber(), "<no number>")])
@pytest.mark.parametrize("good", [1, 4], ids=["first step", "later step"])
def test_a_reward_that_no_float_holds_is_named_with_its_copy(good: int, reward: Any, got: str) -> None:
    said = answer(good, np.zeros(1, np.float32), reward)
    assert said.startswith(f"lane 0, copy 0, step {good - 1}: reward: expected a number, got {got}")


@pytest.mark.parametrize(
    ("space", "observation"),
    [
        (gymnasium.spaces.Box(0, 255, (2,), np.uint8), np.array([0.5, 0.5])),
        (gymnasium.spaces.Box(0, 255, (2,), np.uint8), np.array([256, 0])),
        (gymnasium.spaces.Box(-9, 9, (2,), np.int16), np.array([70000, 0])),
        (gymnasium.spaces.Box(0, 9, (2,), np.int64), [0.5, 1]),
        (gymnasium.spaces.Box(0, 9, (), np.int64), 0.5),
        (gymnasium.spaces.Box(0, 9, (2,), np.uint8), np.array([-1, 0])),
        (gymnasium.spaces.Discrete(3), 1.0),
        (gymnasium.spaces.Discrete(3), True + 0.5),
        (gymnasium.spaces.MultiBinary(2), [0, 300]),
        (gymnasium.spaces.Box(0, 9, (3,), np.float32), np.zeros(1, np.float32)),
        (gymnasium.spaces.Box(0, 9, (3, 2), np.float32), np.zeros((1, 2), np.float32)),
        (gymnasium.spaces.Box(0, 9, (2, 2), np.float32), np.zeros((2, 1), np.float32)),
        (gymnasium.spaces.Box(0, 9, (), np.float32), np.zeros(1, np.float32)),
        (gymnasium.spaces.Box(0, 9, (), np.float32), None),
        (gymnasium.spaces.Dict({"a": gymnasium.spaces.Discrete(3)}), {"a": None}),
    ],
    ids=str,
)
@pytest.mark.parametrize("good", [0, 1, 4], ids=["reset", "first step", "later step"])
def test_an_observation_that_would_lose_its_meaning_is_refused(good: int, space: Any, observation: Any) -> None:
    assert "as its space says" in answer(good, observation, space=space)


@pytest.mark.parametrize(
    ("observation", "got"),
    [
        ({"b": 1}, "a dict of 'b' (KeyError: 'a')"),
        (7, "a int (TypeError: 'int' object is not subscriptable)"),
    ],
)
@pytest.mark.parametrize("good", [0, 4], ids=["reset", "later step"])
def test_an_observation_without_one_of_its_arrays_is_named(good: int, observation: Any, got: str) -> None:
    said = answer(good, observation, space=gymnasium.spaces.Dict({"a": gymnasium.spaces.Discrete(3)}))
    when = f"step {good - 1}" if good else "first reset"
    assert said.startswith(
        f"lane 0, copy 0, {when}: observation: expected the structure of its space, got {got}; fix the environment"
    )


class Turns(Countdown):
    """Gives float32[4], and from its fourth step on what it is told."""

    def __init__(self, *later: Any) -> None:
        super().__init__(50)
        self.observation_space = gymnasium.spaces.Box(-9, 9, (4,), np.float32)
        self._later = later

    def _observation(self) -> Any:
        return self._later[0] if self._later and self._left < 47 else np.zeros(4, np.float32)


def test_the_copy_whose_observation_changes_is_named_even_if_another_makes_up_for_it() -> None:
    short, long = np.zeros(3, np.float32), np.zeros(5, np.float32)
    for copies, named in [((Turns(), Turns(short), Turns(long)), 1), ((Turns(long), Turns(), Turns(short)), 0)]:
        run = msgspec.structs.replace(run_around(copies[0], T=6), copies=3)
        with pytest.raises(
            EnvironmentFailed, match=rf"lane 0, copy {named}, step 3: observation: expected float32\[4\] as its"
        ):
            collect(random_collector(run, loop_over([lambda env=env: env for env in copies])), run)  # type: ignore[misc]


@pytest.mark.parametrize(
    ("space", "given"),
    [
        (gymnasium.spaces.Box(-9, 9, (2,), np.float32), [np.array([1, 2]), [1.0, 2], (True, 2), np.array([1.0, 2.0])]),
        (gymnasium.spaces.Box(0, 9, (2,), np.uint8), [np.array([1, 2]), [1, 2], np.array([1, 2], np.uint64), [True, 2]]),
        (gymnasium.spaces.Discrete(3), [1, np.int32(1), np.array(1, np.uint8), True]),
        (gymnasium.spaces.Box(-9, 9, (), np.float64), [1, np.float32(1), np.array(1.0), 1.0]),
    ],
    ids=str,
)
def test_observations_of_other_types_are_kept_as_long_as_they_mean_the_same(space: Any, given: list[Any]) -> None:
    for observation in given:
        env = Answers(1, observation, space=space)
        env._rows = iter([(observation, 1.0)] * 9)
        run = run_around(env, T=6)
        (rollout,) = collect(random_collector(run, loop_over([lambda env=env: env])), run)  # type: ignore[misc]
        assert (rollout.obs[0] == np.asarray(observation)).all()


class Doubles(Countdown):
    """Says float32 and gives float64, as many do."""

    def _observation(self) -> Any:
        return np.array([0.1])


def test_a_float_may_lose_precision() -> None:
    run = run_of(f"{TOY}Countdown-v0", N=1)
    (rollout,) = collect(random_collector(run, loop_over([Doubles])), run)
    assert (rollout.obs[0] == np.float32(0.1)).all()


class Far(Countdown):
    """Its observations are finite, and too large for float32."""

    def __init__(self, action_space: gymnasium.Space[Any]) -> None:
        super().__init__()
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)  # type: ignore[arg-type]
        self.action_space = action_space

    def _observation(self) -> Any:
        return np.array([1e39, -1e39])


@pytest.mark.parametrize(
    ("action_space", "name"), [(gymnasium.spaces.Discrete(2), "log_prob"), (gymnasium.spaces.Box(-1, 1, (1,)), "action")]
)
def test_an_observation_from_which_no_policy_can_act_is_named(action_space: gymnasium.Space[Any], name: str) -> None:
    run = run_around(Far(action_space), T=4)
    with pytest.raises(EnvironmentFailed) as caught:
        collect(random_collector(run, loop_over([lambda: Far(action_space)])), run)
    said = f"lane 0, {name} of the policy: expected finite values, got nan at step 0, copy 0, from observations up to 1e+39"
    assert str(caught.value) == f"{said}; wrap the environment so that they are smaller"


@pytest.mark.parametrize("observation", [3, -1])
def test_a_discrete_observation_outside_its_space_is_named(observation: int) -> None:
    said = answer(3, observation, space=gymnasium.spaces.Discrete(3))
    assert said == f"lane 0, observation: expected 0 to 2, got {observation} at step 3, copy 0"


@pytest.mark.parametrize(("observation", "wrong"), [([0, 2], 2), ([-1, 1], -1)])
def test_a_multi_binary_observation_that_is_neither_0_nor_1_is_named(observation: list[int], wrong: int) -> None:
    said = answer(3, np.array(observation), space=gymnasium.spaces.MultiBinary(2))
    assert said == f"lane 0, observation: expected 0 to 1, got {wrong} at step 3, copy 0"


@pytest.mark.parametrize(
    ("reward", "said"),
    [
        ("much", "copy 0, step 2: reward: expected a number, got 'much'"),
        ([1.0, 2.0], "copy 0, step 2: reward: expected a number, got an array of shape (2,); wrap the environment so"),
        ([[1.0], [2.0, 3.0]], "copy 0, step 2: reward: expected a number, got [[1.0], [2.0, 3.0]]"),
        (None, "reward: expected finite values, got nan at step 2, copy 0"),
    ],
)
def test_a_reward_that_is_no_number_is_refused(reward: Any, said: str) -> None:
    assert answer(3, np.zeros(1, np.float32), reward).startswith(f"lane 0, {said}")


@pytest.mark.parametrize(
    ("name", "value", "got"),
    [
        ("reward", None, "None"),  # a step without a reward: numpy would make NaN of it
        ("reward", "1", "'1'"),
        ("terminated", "no", "'no'"),  # it would be True
        ("truncated", b"", "b''"),
    ],
)
def test_what_numpy_would_take_for_a_number_is_refused_in_the_first_step(name: str, value: Any, got: str) -> None:
    class Slips(Countdown):
        def step(self, action: Any) -> Any:
            observation, *numbers, info = super().step(action)
            numbers[("reward", "terminated", "truncated").index(name)] = value
            return observation, *numbers, info

    run = run_around(Slips(), T=6)
    with pytest.raises(EnvironmentFailed) as caught:
        collect(random_collector(run, loop_over([Slips])), run)
    expects = "its step must return (observation, reward, terminated, truncated, info)"
    assert str(caught.value) == f"lane 0, copy 0, step 0: {name}: expected a number, got {got}; {expects}"


@pytest.mark.parametrize("copies", [1, 3])
@pytest.mark.parametrize("reward", [np.array([2.5]), [2.5], np.array([[2.5]], np.float32), np.float64(2.5), np.array(2.5)])
def test_a_reward_of_one_element_is_a_number(reward: Any, copies: int) -> None:
    class Rewards(Countdown):
        def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
            observation, _, terminated, truncated, info = super().step(action)
            return observation, reward, np.array([terminated]), truncated, info

    run = msgspec.structs.replace(run_around(Rewards(), T=6), copies=copies)
    (rollout,) = collect(random_collector(run, loop_over([Rewards] * copies)), run)
    assert rollout.reward.tolist() == [[2.5] * copies] * 5 + [[0.0] * copies]
    assert rollout.terminated.sum() == copies


def test_a_vector_environment_whose_rewards_are_not_one_for_each_copy_is_named() -> None:
    class One(SyncVectorEnv):
        def step(self, actions: Any) -> Any:
            observation, reward, *rest = super().step(actions)
            return observation, reward[:1], *rest

    run = run_of(f"{TOY}Countdown-v0", N=2)
    with pytest.raises(
        EnvironmentFailed, match=r"lane 0, step 0: reward: expected one for each of 2 copies, got an array of shape"
    ):
        collect(random_collector(run, lambda r, lane, pulse: VectorCopies(One([Countdown] * 2))), run)


@pytest.mark.parametrize("kind", [list, lambda flags: flags.astype(np.float32)], ids=["lists", "numbers"])
def test_the_flags_of_a_vector_environment_need_not_be_bool_arrays(kind: Callable[[Array], Any]) -> None:
    class Converted(SyncVectorEnv):
        def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
            observation, reward, terminated, truncated, info = super().step(actions)
            return observation, reward, kind(terminated), kind(truncated), info

    run = run_of(f"{TOY}Countdown-v0")
    (converted,) = collect(random_collector(run, lambda run, lane, pulse: VectorCopies(Converted([Countdown] * 2))), run)
    (expected,) = collect(random_collector(run, sync_vector_env_over([Countdown] * 2)), run)
    assert bits(converted) == bits(expected)


def test_a_nan_is_named_even_if_the_environment_then_chokes_on_it() -> None:
    said = answer(3, np.full(1, np.nan, np.float32))
    assert said == "lane 0, observation: expected finite values, got nan at step 3, copy 0"
    assert "what happens after such a row" in answer(3, np.zeros(1, np.float32))


def test_an_environment_of_another_version_is_refused() -> None:
    run = with_env(run_of("CartPole-v1"), "Acrobot-v1")
    with pytest.raises(UsageError, match=r"environment Acrobot-v1: its observations .* are not those of the policy"):
        collect(random_collector(run), run)
