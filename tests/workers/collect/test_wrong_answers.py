"""What `reset` and `step` return in another form than gymnasium's is named, with what was expected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit, TransformObservation

from millrace.extras.envs.vector_copies import VectorCopies
from millrace.protocol.errors import EnvironmentFailed
from tests.support.in_process.collectors import collect, evaluated, loop_over, random_collector, random_policy, run_around

STEP = "expected (observation, reward, terminated, truncated, info)"
RESET = "expected (observation, info): end it with `return observation, {}`"
PAIR = spaces.Box(-9, 9, (2,), np.float32)
FIVE = spaces.Box(-9, 9, (5,), np.float32)


class Form(gymnasium.Env[Any, Any]):
    """Returns what it is told."""

    action_space = spaces.Discrete(2)

    def __init__(self, reset: Any = None, step: Any = None, space: spaces.Space[Any] = PAIR) -> None:
        self.observation_space = space
        seen = space.sample()
        self._reset, self._step = (
            (seen, {}) if reset is None else reset,
            (seen, 1.0, False, False, {}) if step is None else step,
        )
        self.later: Any = None

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self._reset

    def step(self, action: Any) -> Any:
        return self._step


def said_of(env: gymnasium.Env[Any, Any]) -> str:
    """What a collector says of it."""
    run = run_around(env, T=4)
    with pytest.raises(EnvironmentFailed) as caught:
        collect(random_collector(run, loop_over([lambda: env])), run)
    assert "\n" not in str(caught.value)
    return str(caught.value)


ZEROS = np.zeros(2, np.float32)
TWO_DISCRETE = spaces.Tuple([spaces.Discrete(3), spaces.Discrete(3)])
WITH_DICT = spaces.Tuple([spaces.Discrete(3), spaces.Dict({"a": spaces.Discrete(3)})])


@pytest.mark.parametrize(
    ("answer", "space", "got"),
    [
        (ZEROS, PAIR, "float32[2]"),
        (np.zeros(5, np.float32), FIVE, "float32[5]"),
        ([0.0, 1.0], PAIR, "2 values (float, float)"),
        ((0, 1), TWO_DISCRETE, "2 values (int, int)"),
        ({"a": 1, "b": 2}, spaces.Dict({"a": spaces.Discrete(3), "b": spaces.Discrete(3)}), "dict"),
        (np.int64(1), spaces.Discrete(3), "int64"),
        ((ZEROS, 1.0, False, {}), PAIR, "4 values (float32[2], float, bool, dict)"),
        ((ZEROS, []), PAIR, "2 values (float32[2], list)"),
        ((), PAIR, "0 values ()"),
    ],
    ids=str,
)
def test_a_reset_that_returns_something_else_is_named(answer: Any, space: spaces.Space[Any], got: str) -> None:
    """Above all the observation alone, also one of two elements."""
    assert said_of(Form(reset=answer, space=space)) == f"lane 0, copy 0, first reset: its reset returned {got}; {RESET}"


@pytest.mark.parametrize(
    ("answer", "got"),
    [
        ((ZEROS, 1.0, False, {}), "4 values (float32[2], float, bool, dict)"),
        ([ZEROS, 1.0, False], "3 values (float32[2], float, bool)"),
        (ZEROS, "float32[2]"),
        (np.zeros(5, np.float32), "float32[5]"),
        ((ZEROS, 1.0, False, False, {}, 3, 4), "7 values (float32[2], float, bool, bool, dict, int, …)"),
        ((ZEROS, 1.0, False, False, []), "5 values (float32[2], float, bool, bool, list)"),
        ((ZEROS, 1.0, False, False, 0.0), "5 values (float32[2], float, bool, bool, float)"),
    ],
    ids=str,
)
def test_a_step_that_returns_something_else_is_named(answer: Any, got: str) -> None:
    advice = ", not the old form with `done`: truncated is True if a time limit ends the episode"
    said = said_of(Form(step=answer))
    assert said == f"lane 0, copy 0, step 0: its step returned {got}; {STEP}{advice if got.startswith('4') else ''}"


def test_a_step_that_returns_nothing_is_named() -> None:
    class Nothing(Form):
        def step(self, action: Any) -> Any:
            return None

    assert said_of(Nothing()) == f"lane 0, copy 0, step 0: its step returned None; {STEP}"


@pytest.mark.parametrize("info", [None, {}])
def test_an_info_may_be_missing(info: Any) -> None:
    env = Form(reset=(ZEROS, info), step=(ZEROS, 1.0, False, True, info))
    run = run_around(env, T=6)
    (rollout,) = collect(random_collector(run, loop_over([lambda: env])), run)
    assert len(rollout.episodes) == 3


def test_the_reset_after_an_episode_is_looked_at_too() -> None:
    class Later(Form):
        resets = 0

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            self.resets += 1
            return self._reset if self.resets == 1 else ZEROS

    said = said_of(Later(step=(ZEROS, 1.0, True, False, {})))
    assert said == f"lane 0, copy 0, step 1: its reset returned float32[2]; {RESET}"


@pytest.mark.parametrize(
    ("wrapped", "says"),
    [
        (
            lambda: TimeLimit(Form(step=(ZEROS, 1.0, False, {})), 5),
            f"not enough values to unpack (expected 5, got 4); step below this wrapper returned another form: {STEP}",
        ),
        (
            lambda: RecordEpisodeStatistics(Form(reset=np.zeros(3))),
            "; reset below this wrapper returned another form: expected (observation, info)",
        ),
    ],
)
def test_a_wrapper_that_cannot_unpack_it_says_what_was_expected(wrapped: Callable[[], Any], says: str) -> None:
    assert says in said_of(wrapped())


def test_two_numbers_that_a_wrapper_took_for_observation_and_info_are_named() -> None:
    env = TransformObservation(Form(reset=[0.0, 1.0]), lambda seen: seen, PAIR)
    assert said_of(env) == f"lane 0, copy 0, first reset: its reset returned 2 values (float, float); {RESET}"


def test_code_of_the_environment_that_unpacks_something_else_gets_no_such_advice() -> None:
    class Unpacks(Form):
        def step(self, action: Any) -> Any:
            first, *_ = action
            return super().step(first)

    assert "returned" not in said_of(Unpacks())


@pytest.mark.parametrize(("reset", "step", "says"), [
    (ZEROS, None, f"reset: its reset returned float32[2]; {RESET}"),
    (None, (ZEROS, 1.0, False, {}), "step 0: its step returned 4 values (float32[2], float, bool, dict)"),
])  # fmt: skip
def test_evaluations_say_the_same(reset: Any, step: Any, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run = msgspec.structs.replace(run_around(Form(), T=4))
    monkeypatch.setattr("millrace.protocol.env_spec.EnvSpec.make", lambda spec, render_mode=None: Form(reset, step))
    with pytest.raises(EnvironmentFailed) as caught:
        evaluated(run, random_policy(run.policy), 1, 0)
    assert str(caught.value).startswith(f"while the policy was evaluated: copy 0, {says}")


def test_a_vector_environment_is_held_to_the_same_forms() -> None:
    class OldReset(SyncVectorEnv):
        def reset(self, **keywords: Any) -> Any:
            return super().reset(**keywords)[0]

    class OldStep(SyncVectorEnv):
        def step(self, actions: Any) -> Any:
            return super().step(actions)[:4]

    run = run_around(Form(), T=4)
    for made, says in (
        (OldReset, f"lane 0, first reset: its reset returned float32[1, 2]; {RESET}"),
        (OldStep, "lane 0, step 0: its step returned 4 values (float32[1, 2], float64[1], bool[1], bool[1]); expected"),
    ):
        with pytest.raises(EnvironmentFailed) as caught:
            collect(random_collector(run, lambda r, lane, pulse, made=made: VectorCopies(made([Form]))), run)  # type: ignore[misc]
        assert str(caught.value).startswith(says)
