"""What gymnasium's tests assert of its vector environments holds for ours: spaces, seeds, masks, calls, errors, closing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

import millrace
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.protocol.errors import EnvironmentFailed, UsageError
from tests.support.envs.toy import ACTIONS, OBSERVATIONS, UNSUPPORTED_ACTIONS, UNSUPPORTED_OBSERVATIONS
from tests.support.in_process.described import with_spaces
from tests.support.numbers.bit_equality import bit_equal

SPACES = "tests.support.envs.toy:Spaces-v0"


def inproc(env: Any, num_envs: int | None = 3, **keywords: Any) -> ZmqVectorEnv:
    """With one worker that is a thread, because no test here depends on the transport."""
    return millrace.make_vec(env, num_envs, **{"workers": 1, "transport": "inproc", "timeout": 20.0, **keywords})


def sync(env: str, num_envs: int, **kwargs: Any) -> SyncVectorEnv[Any, Any]:
    return SyncVectorEnv([lambda: gymnasium.make(env, disable_env_checker=True, **kwargs) for _ in range(num_envs)])


# ---------------------------------------------------------------- spaces


def space_cases() -> list[tuple[str, str]]:
    observations = [(name, "discrete") for name in OBSERVATIONS if name not in UNSUPPORTED_OBSERVATIONS]
    return observations + [("box", name) for name in ACTIONS if name not in UNSUPPORTED_ACTIONS]


@pytest.mark.parametrize(("observation", "action"), space_cases())
def test_every_supported_space_is_batched(observation: str, action: str) -> None:
    theirs = sync(SPACES, 3, observation=observation, action=action)
    with inproc(SPACES, observation=observation, action=action) as env:
        assert env.observation_space == batch_space(env.single_observation_space, 3) == theirs.observation_space
        assert env.action_space == batch_space(env.single_action_space, 3) == theirs.action_space
        first, infos = env.reset(seed=3)
        assert first in env.observation_space
        assert infos == {}
        assert bit_equal(first, theirs.reset(seed=3)[0])
        theirs.action_space.seed(1)
        for _ in range(6):
            actions = theirs.action_space.sample()
            row = env.step(actions)
            assert row[0] in env.observation_space
            assert bit_equal(row, theirs.step(actions))
    theirs.close()


@pytest.mark.parametrize("shared_memory", [True, False])
def test_observations_of_half_precision(shared_memory: bool) -> None:
    class Half(gymnasium.Env[Any, Any]):
        observation_space = spaces.Box(-1, 1, (3,), np.float16)
        action_space = spaces.Discrete(2)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
            super().reset(seed=seed)
            return np.full(3, 0.1, np.float16), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            return np.full(3, 0.2, np.float16), 1, False, False, {}

    with millrace.make_vec(Half, 2, workers=1, shared_memory=shared_memory) as env:
        for observation, value in (env.reset()[0], 0.1), (env.step(np.zeros(2, np.int64))[0], 0.2):
            assert bit_equal(observation, np.full((2, 3), value, np.float16))


class Sign(spaces.Space[str]):
    """A space that gymnasium does not know."""


def test_a_custom_space_is_refused_in_one_line() -> None:
    def with_custom_space() -> gymnasium.Env[Any, Any]:
        env = gymnasium.make(SPACES)
        env.unwrapped.observation_space = Sign()
        return env.unwrapped

    with pytest.raises(UsageError, match=r"observation space .* is not supported") as raised:
        inproc(with_custom_space)
    assert "\n" not in str(raised.value)


BOX, DISCRETE = spaces.Box(-1, 1, (2,), np.float64), spaces.Discrete(2)


@pytest.mark.parametrize(
    ("observation", "action"),
    [
        (spaces.Box(-1, 5, (2,), np.float64), DISCRETE),
        (spaces.Box(-1, 1, (3,), np.float64), DISCRETE),
        (spaces.Box(-1, 1, (2,), np.float32), DISCRETE),
        (spaces.Dict({"a": BOX}), DISCRETE),
        (BOX, spaces.Discrete(3)),
        (BOX, spaces.Box(-1, 1, (1,))),
    ],
    ids=["bounds", "shape", "dtype", "keys", "n", "kind"],
)
def test_copies_of_different_spaces_are_refused_before_the_first_reset(
    observation: spaces.Space[Any], action: spaces.Space[Any]
) -> None:
    makes = [partial(with_spaces, BOX, DISCRETE)] * 3 + [partial(with_spaces, observation, action)]
    with pytest.raises(EnvironmentFailed, match=r"copy 3: its observations .*all copies must have the same") as raised:
        inproc(makes, None, lanes=2)
    assert "\n" not in str(raised.value)
    with pytest.raises((RuntimeError, AssertionError)):  # the latter by gymnasium 1.3
        SyncVectorEnv(makes)


def test_bounds_that_differ_by_rounding_are_the_same() -> None:
    """As for gymnasium: another processor may round them otherwise."""
    near = spaces.Box(-1, np.nextafter(1, 2), (2,), np.float64)
    makes = [partial(with_spaces, BOX, DISCRETE), partial(with_spaces, near, DISCRETE)]
    inproc(makes, None).close()
    SyncVectorEnv(makes).close()


@pytest.mark.parametrize("mode", ["different", (spaces.Box(-9, 9, (3, 2), np.float64), spaces.Box(-9, 9, (2,), np.float64))])
def test_bounds_of_observations_may_differ_with_another_observation_mode(mode: Any) -> None:
    class AtItsBound(gymnasium.Env[Any, Any]):
        def __init__(self, bound: float) -> None:
            self.observation_space: Any = spaces.Box(-bound, bound, (2,), np.float64)
            self.action_space = DISCRETE

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
            return self.observation_space.high, {}

    makes = [partial(AtItsBound, bound) for bound in (1.0, 2.0, 3.0)]
    theirs = SyncVectorEnv(makes, observation_mode=mode)
    with inproc(makes, None, observation_mode=mode) as ours:
        assert ours.observation_space == theirs.observation_space
        assert ours.single_observation_space == theirs.single_observation_space
        assert bit_equal(ours.reset()[0], theirs.reset()[0])
    theirs.close()


@pytest.mark.parametrize("mode", ["different", (spaces.Box(-9, 9, (2, 3)), spaces.Box(-9, 9, (3,)))])
def test_shapes_and_action_spaces_do_not_differ_in_any_observation_mode(mode: Any) -> None:
    for observation, action in (spaces.Box(-1, 1, (3,), np.float64), DISCRETE), (BOX, spaces.Discrete(3)):
        makes = [partial(with_spaces, BOX, DISCRETE), partial(with_spaces, observation, action)]
        with pytest.raises(EnvironmentFailed, match="all copies must have the same"):
            inproc(makes, None, observation_mode=mode)


def test_the_metadata_of_the_environment_is_not_changed() -> None:
    before = dict(gymnasium.make("CartPole-v1").metadata)
    with inproc("CartPole-v1", autoreset_mode="NextStep") as a, inproc("CartPole-v1", autoreset_mode="SameStep") as b:
        assert a.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        assert b.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert gymnasium.make("CartPole-v1").metadata == before


# ---------------------------------------------------------------- reset and step


@pytest.mark.parametrize("as_list", [True, False])
def test_types_and_shapes_of_a_step(as_list: bool) -> None:
    """Also for a list of single actions."""
    with inproc("CartPole-v1") as env:
        observation, infos = env.reset()
        assert (observation.dtype, observation.shape, type(infos)) == (np.float32, (3, 4), dict)
        actions = [env.single_action_space.sample() for _ in range(3)] if as_list else env.action_space.sample()
        observation, reward, terminated, truncated, infos = env.step(actions)
        assert (observation.dtype, observation.shape, type(infos)) == (np.float32, (3, 4), dict)
        assert [array.dtype for array in (reward, terminated, truncated)] == [np.float64, np.bool_, np.bool_]
        assert {array.shape for array in (reward, terminated, truncated)} == {(3,)}


def test_each_copy_has_its_own_seed_and_keeps_it() -> None:
    with inproc("CartPole-v1") as env:
        assert len(set(env.np_random_seed)) == 3, "before the first reset"
        first, _ = env.reset(seed=42)
        assert env.np_random_seed == (42, 43, 44)
        assert len({row.tobytes() for row in first}) == 3
        again, _ = env.reset()
        assert env.np_random_seed == (42, 43, 44)
        assert (again != first).all(), "a reset without a seed continues with the same generator"
        assert (env.reset(seed=[42, None, 7])[0][0] == first[0]).all()
        assert env.np_random_seed == (42, 43, 7)


def test_a_reset_mask_leaves_the_other_copies_unchanged() -> None:
    with inproc("CartPole-v1", autoreset_mode="Disabled") as env:
        env.reset(options={"reset_mask": np.array([True, False, True])})
        with pytest.raises(UsageError, match=r"step before reset of copies \[1\]"):
            env.step(np.zeros(3, np.int64))
        first, _ = env.reset(seed=[0, 1, 2], options={"reset_mask": np.array([True, True, True])})
        for _ in range(3):
            stepped = env.step(np.zeros(3, np.int64))[0]
        mask = np.array([True, True, False])
        options = {"reset_mask": mask}
        after, _ = env.reset(seed=[0, 1, 0], options=options)
        assert (after[:2] == first[:2]).all()
        assert (after[2] == stepped[2]).all()
        for wrong, error in (
            (np.array([True]), ValueError),
            (np.array([True, True, False, False]), ValueError),
            (np.array([[True, True, True]]), ValueError),
            (np.array([1, 1, 0]), TypeError),
            (np.array([1.0, 1.0, 0.0]), TypeError),
            (np.zeros(3, bool), ValueError),
        ):
            with pytest.raises(error, match="reset_mask"):
                env.reset(options={"reset_mask": wrong})
        assert env.step(np.zeros(3, np.int64))[1].tolist() == [1.0] * 3
        for actions, error in (np.zeros(2, np.int64), ValueError), (np.zeros(4, np.int64), ValueError), (0, TypeError):
            with pytest.raises(error, match="actions: expected one for each of 3 rows"):
                env.step(actions)


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)
def test_the_end_of_an_episode_in_each_autoreset_mode(mode: AutoresetMode) -> None:
    zeros = np.zeros(2, np.int64)
    with inproc("tests.support.envs.toy:Countdown-v0", 2, k=2, autoreset_mode=mode) as env:
        env.reset(seed=1)
        env.step(zeros)
        observation, reward, terminated, _, infos = env.step(zeros)
        assert terminated.all()
        assert reward.tolist() == [1.0, 1.0]
        if mode is AutoresetMode.SAME_STEP:
            assert observation.tolist() == [[1.0], [1.0]]
            assert [final.tolist() for final in infos["final_obs"]] == [[0.0], [0.0]]
            assert infos["_final_obs"].tolist() == infos["_final_info"].tolist() == [True, True]
            assert infos["final_info"] == {}
            return
        assert observation.tolist() == [[0.0], [0.0]]
        assert "final_obs" not in infos
        if mode is AutoresetMode.NEXT_STEP:
            observation, reward, terminated, *_ = env.step(zeros)
            assert (observation.tolist(), reward.tolist()) == ([[1.0], [1.0]], [0.0, 0.0])
            assert not terminated.any()
        else:
            with pytest.raises(UsageError, match=r"copies \[0, 1\] have ended"):
                env.step(zeros)


def test_an_error_in_reset_has_the_traceback_of_the_worker() -> None:
    class RaisesInReset(gymnasium.Env[Any, Any]):
        observation_space, action_space = spaces.Discrete(2), spaces.Discrete(2)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
            if seed == 1:
                raise ValueError("not this seed")
            return 0, {}

    with inproc(RaisesInReset, 2, workers=1) as env:
        assert env.reset(seed=[0, 0])[0].tolist() == [0, 0]
        with pytest.raises(EnvironmentFailed, match=r"copy 1, reset: its environment raised ValueError: not this seed") as e:
            env.reset(seed=[0, 1])
        assert 'raise ValueError("not this seed")' in e.value.detail


# ---------------------------------------------------------------- calls


def test_attributes_can_be_set_before_the_first_reset_but_not_with_a_wrong_number_of_values() -> None:
    with inproc("CartPole-v1", 4) as env:
        env.set_attr("gravity", [9.81, 3.72, 8.87, 1.62])
        assert env.get_attr("gravity") == (9.81, 3.72, 8.87, 1.62)
        env.reset(seed=1)
        for wrong in ([1.0, 2.0], (1.0,) * 5, []):
            with pytest.raises(ValueError, match="values: expected one for each of 4 copies"):
                env.set_attr("gravity", wrong)
        assert env.get_attr("gravity") == (9.81, 3.72, 8.87, 1.62)
        env.set_attr("gravity", 9.8)
        assert env.call("gravity") == (9.8,) * 4


def test_lists_of_frames_are_rendered() -> None:
    with inproc("CartPole-v1", 2, render_mode="rgb_array_list") as env:
        env.reset()
        images = env.call("render")
        assert [[frame.shape for frame in frames] for frames in images] == [[(400, 600, 3)]] * 2


# ---------------------------------------------------------------- pending and closed

METHODS: dict[str, Callable[[ZmqVectorEnv], object]] = {
    "reset": lambda env: env.reset(),
    "step": lambda env: env.step(np.zeros(3, np.int64)),
    "step_async": lambda env: env.step_async(np.zeros(3, np.int64)),
    "call": lambda env: env.call("gravity"),
    "get_attr": lambda env: env.get_attr("gravity"),
    "set_attr": lambda env: env.set_attr("gravity", 1.0),
    "render": lambda env: env.render(),
    "step_wait": lambda env: env.step_wait(),
    "reset_async": lambda env: env.reset_async(),
    "reset_wait": lambda env: env.reset_wait(),
}


@pytest.mark.parametrize("pending", ["step", "reset"])
def test_while_a_step_or_a_reset_is_pending_other_calls_are_refused(pending: str) -> None:
    with inproc("CartPole-v1") as env:
        first = env.reset(seed=1)
        if pending == "step":
            env.step_async(np.zeros(3, np.int64))
        else:
            env.reset_async(seed=1)
        for name, method in METHODS.items():
            if not name.endswith("_wait"):
                with pytest.raises(AlreadyPendingCallError, match=f"a {pending} is pending|have not come back"):
                    method(env)
            elif name != f"{pending}_wait":
                with pytest.raises(NoAsyncCallError):
                    method(env)
        if pending == "step":
            assert env.step_wait()[1].tolist() == [1.0] * 3, "the refused calls must not disturb the step"
        else:
            assert bit_equal(env.reset_wait(), first), "the refused calls must not disturb the reset"


def test_what_was_received_after_reset_async_is_not_waited_for_again() -> None:
    with millrace.make_vec("CartPole-v1", 3, workers=1, lanes=3, transport="inproc") as env:
        env.reset_async(seed=1)
        assert len(env.recv(2)[1]) >= 2
        with pytest.raises(NoAsyncCallError, match="reset_wait without reset_async before it"):
            env.reset_wait()
        while env.outstanding:
            env.recv()
        env.reset_async(env_ids=[1])
        env.send(np.zeros(2, np.int64), [0, 2])
        with pytest.raises(NoAsyncCallError):
            env.reset_wait()
        assert env.recv(3)[1].tolist() == [1.0, 0.0, 1.0]
        with pytest.raises(ValueError, match=r"expected env_ids or options\['reset_mask'\], got both"):
            env.reset_async(options={"reset_mask": np.ones(3, bool)}, env_ids=[1])


@pytest.mark.parametrize("pending", [False, True])
def test_after_close_every_call_is_refused(pending: bool) -> None:
    env = inproc("CartPole-v1")
    env.reset(seed=1)
    if pending:
        env.step_async(np.zeros(3, np.int64))
    env.close()
    env.close()
    assert env.closed
    for method in METHODS.values():
        with pytest.raises(ClosedEnvironmentError, match=r"after close\(\)"):
            method(env)
