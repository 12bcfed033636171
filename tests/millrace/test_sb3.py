"""The face for Stable-Baselines3 gives what its own vector environments give."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv

import millrace
from millrace.protocol.envs.seats import seated
from millrace.protocol.errors import UsageError
from tests.support.gymnasium_versions import TAXI
from tests.support.numbers.bit_equality import bit_equal
from tests.support.users_code.seat_envs import AGENTS, RandomCrowd, RandomGame, RandomTeam

sb3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common import env_util  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.monitor import Monitor  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv  # noqa: E402

from millrace.sb3 import Sb3VecEnv, make_vec_env  # noqa: E402

A = len(AGENTS)


def dummy(env: str, copies: int, **kwargs: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return DummyVecEnv([lambda: gymnasium.make(env, disable_env_checker=True, **kwargs) for _ in range(copies)])


@pytest.mark.parametrize("env", ["CartPole-v1", TAXI])
def test_it_is_the_dummy_vec_env_to_the_bit(env: str) -> None:
    theirs = dummy(env, 3, max_episode_steps=15)
    ours = make_vec_env(env, 3, monitor=False, workers=2, env_kwargs={"max_episode_steps": 15})
    try:
        ours.seed(5), theirs.seed(5)
        assert bit_equal(ours.reset(), theirs.reset())
        draw = np.random.default_rng(2)
        for _ in range(100):
            action = draw.integers(0, theirs.action_space.n, 3)
            (*mine, infos), (*wanted, their_infos) = ours.step(action), theirs.step(action)
            assert bit_equal(mine, wanted)
            for info, other in zip(infos, their_infos, strict=True):
                assert info.keys() == other.keys()
                assert all(np.array_equal(info[key], other[key]) for key in info)
    finally:
        ours.close(), theirs.close()


class RemembersActions(gymnasium.Env[Any, Any]):
    """Its infos have the action that it got, and the options of its reset."""

    observation_space = gymnasium.spaces.Box(0, 1, (1,))

    def __init__(self, action_space: gymnasium.Space[Any]) -> None:
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(1, np.float32), {"options": options}

    def step(self, action: Any) -> Any:
        leaves = action.items() if isinstance(action, dict) else enumerate(action)
        got = {str(key): np.asarray(value).tolist() for key, value in leaves}
        return np.zeros(1, np.float32), 0.0, False, False, {"got": got, "is": type(action).__name__}


NESTED_ACTIONS = {
    "as many entries as copies": (
        gymnasium.spaces.Tuple([gymnasium.spaces.Discrete(4)] * 3),
        [(0, 1, 2), (3, 3, 3), (1, 0, 0)],
    ),
    "fewer entries": (
        gymnasium.spaces.Tuple([gymnasium.spaces.Discrete(4), gymnasium.spaces.Box(-1, 1, (2,), np.float64)]),
        [(0, np.array([0.1, 0.2])), (3, np.array([-1.0, 1.0])), (2, np.array([0.0, 0.5]))],
    ),
    "a Dict": (
        gymnasium.spaces.Dict({"b": gymnasium.spaces.Discrete(4), "a": gymnasium.spaces.MultiBinary(2)}),
        [{"a": np.array([0, 1], np.int8), "b": n} for n in range(3)],
    ),
}


@pytest.mark.parametrize("case", NESTED_ACTIONS)
def test_each_copy_gets_its_own_tuple_or_dict_of_actions(case: str) -> None:
    space, actions = NESTED_ACTIONS[case]
    makes = [partial(RemembersActions, space)] * 3
    theirs: Any = DummyVecEnv([partial(RemembersActions, space) for _ in range(3)])
    ours = make_vec_env(makes, monitor=False, transport="inproc")
    try:
        ours.reset(), theirs.reset()
        (*_, infos), (*_, their_infos) = ours.step(actions), theirs.step(actions)  # type: ignore[arg-type]
        assert [(info["got"], info["is"]) for info in infos] == [(info["got"], info["is"]) for info in their_infos]
    finally:
        ours.close(), theirs.close()


class DifferentInfos(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The info of each step has an array that is longer than the last one, and a number of its own type."""

    def __init__(self, number: float) -> None:
        super().__init__(gymnasium.make("CartPole-v1", max_episode_steps=5 if type(number) is int else 4))
        self._number, self._length = number, 1

    def step(self, action: Any) -> Any:
        self._length += 1
        return *super().step(action)[:4], {"number": self._number, "array": np.zeros(self._length), "deep": {"none": None}}


def test_infos_are_those_of_each_copy() -> None:
    makes: list[Any] = [partial(DifferentInfos, 1), partial(DifferentInfos, 0.5)]
    theirs: Any = DummyVecEnv(makes)
    ours = make_vec_env(makes, monitor=False, transport="inproc")
    try:
        ours.seed(1), theirs.seed(1)
        assert bit_equal(ours.reset(), theirs.reset())
        for t in range(20):
            (*mine, infos), (*wanted, their_infos) = ours.step(np.full(2, t % 2)), theirs.step(np.full(2, t % 2))
            assert bit_equal(mine, wanted)
            assert bit_equal(
                [dict(sorted(info.items())) for info in infos], [dict(sorted(info.items())) for info in their_infos]
            )
    finally:
        ours.close(), theirs.close()


def test_attributes_and_methods_by_index() -> None:
    env = make_vec_env("tests.support.envs.toy:Informs-v0", 3, monitor=False, transport="inproc")
    assert isinstance(env, Sb3VecEnv)
    env.set_attr("level", 7, indices=[2, 0])
    assert env.get_attr("level") == [7, 1, 7]
    assert env.get_attr("level", indices=[1, 0]) == [1, 7]
    assert env.env_method("shout", "a", indices=1) == ["A"]
    assert env.env_method("shout", "a", indices=np.array([0, 2])) == ["A", "A"]
    env.set_attr("level", 9, indices=np.array([-1, 2]))
    assert env.get_attr("level") == [7, 1, 9]
    with pytest.raises(IndexError):
        env.get_attr("level", indices=3)
    assert env.has_attr("level")
    assert env.has_attr("shout")  # which needs an argument
    assert not env.has_attr("no_such_thing")
    env.close()


def ten_times_within() -> gymnasium.Env[Any, Any]:
    return TenTimes(gymnasium.wrappers.TransformReward(gymnasium.make("CartPole-v1"), float))


def test_env_copies_know_their_wrappers() -> None:
    makes: list[Any] = [ten_times_within, partial(gymnasium.make, "CartPole-v1"), CartPoleEnv]
    theirs: Any = DummyVecEnv(makes)
    ours = make_vec_env(makes, monitor=False, transport="inproc", lanes=2)
    try:
        for kind in (TenTimes, gymnasium.wrappers.TransformReward, gymnasium.RewardWrapper, gymnasium.wrappers.TimeLimit,
                     gymnasium.Wrapper, Monitor, gymnasium.wrappers.RecordVideo):  # fmt: skip
            assert ours.env_is_wrapped(kind) == theirs.env_is_wrapped(kind)
        assert ours.env_is_wrapped(TenTimes, indices=[2, 0, 0]) == [False, True, True]
    finally:
        ours.close(), theirs.close()


class Still:
    """A model whose actions are zeros."""

    def predict(self, observations: Any, **keywords: Any) -> tuple[Any, None]:
        return np.zeros(len(observations), np.int64), None


def test_an_evaluation_has_the_rewards_of_the_environment_also_in_a_wrapper() -> None:
    """Stable-Baselines3's `evaluate_policy` asks whether a `Monitor` records the episodes."""
    keywords: dict[str, Any] = {"seed": 3, "wrapper_class": TenTimes}
    ours = make_vec_env("CartPole-v1", 2, transport="inproc", **keywords)
    theirs = env_util.make_vec_env("CartPole-v1", 2, **keywords)
    found, wanted = (evaluate_policy(Still(), env, n_eval_episodes=6) for env in (ours, theirs))  # type: ignore[arg-type]
    assert found == wanted
    ours.close(), theirs.close()


def test_each_copy_may_have_options_of_its_own() -> None:
    space = gymnasium.spaces.Discrete(2)
    theirs: Any = DummyVecEnv([partial(RemembersActions, space) for _ in range(3)])
    ours = make_vec_env([partial(RemembersActions, space)] * 3, monitor=False, transport="inproc", lanes=2)
    try:
        each: tuple[Any, ...] = [{"a": 1}, {}, {"b": np.arange(2)}], {"c": 3}, None
        for options in each:
            ours.set_options(options)
            theirs.set_options(options)
            ours.reset(), theirs.reset()
            assert bit_equal(ours.reset_infos, theirs.reset_infos)
            ours.reset(), theirs.reset()
            assert ours.reset_infos == theirs.reset_infos == [{"options": None}] * 3, "they hold for one reset"
        ours.set_options([{"a": 1}] * 2)
        with pytest.raises(ValueError, match="options: expected one for each of 3 copies, got 2"):
            ours.reset()
    finally:
        ours.close(), theirs.close()


def test_ppo_learns_on_it() -> None:
    env = make_vec_env("CartPole-v1", 4, seed=1, workers=2)
    model = sb3.PPO("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, device="cpu", seed=1)
    model.learn(256)
    assert model.num_timesteps == 256
    assert model.ep_info_buffer[0]["r"] > 0
    env.close()


class TenTimes(gymnasium.RewardWrapper[Any, Any]):
    """Rewards times a factor."""

    def __init__(self, env: gymnasium.Env[Any, Any], factor: float = 10.0) -> None:
        super().__init__(env)
        self.factor = factor

    def reward(self, reward: Any) -> float:
        return self.factor * float(reward)


def test_wrapper_class_wraps_each_copy_and_episodes_are_those_of_the_environment() -> None:
    """As Stable-Baselines3's own function: rewards, observations, and the return and length of each episode."""
    keywords: dict[str, Any] = {"wrapper_class": TenTimes, "wrapper_kwargs": {"factor": 3.0}}
    ours = make_vec_env("CartPole-v1", 2, seed=1, workers=1, env_kwargs={"max_episode_steps": 12}, **keywords)
    theirs = env_util.make_vec_env("CartPole-v1", 2, seed=1, env_kwargs={"max_episode_steps": 12}, **keywords)
    try:
        assert ours.get_attr("factor") == [3.0, 3.0]
        assert bit_equal(ours.reset(), theirs.reset())
        episodes = 0
        for t in range(60):
            action = np.random.default_rng(t).integers(0, 2, 2)
            (*mine, infos), (*wanted, their_infos) = ours.step(action), theirs.step(action)
            assert bit_equal(mine, wanted)
            for info, other in zip(infos, their_infos, strict=True):
                assert ("episode" in info) == ("episode" in other)
                if "episode" in info:
                    episodes += 1
                    assert [info["episode"][key] for key in "rl"] == [other["episode"][key] for key in "rl"]
        assert episodes > 6
    finally:
        ours.close(), theirs.close()


def test_a_worker_that_wraps_needs_no_stable_baselines3() -> None:
    def loaded(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
        import sys

        env.unwrapped.loaded = [name for name in ("stable_baselines3", "torch") if name in sys.modules]  # type: ignore[attr-defined]
        return env

    env = make_vec_env("CartPole-v1", 1, wrapper_class=loaded, workers=1)
    assert env.get_attr("loaded") == [[]]
    env.close()


def test_a_list_of_environments_and_callables_are_wrapped() -> None:
    def short() -> gymnasium.Env[Any, Any]:
        return gymnasium.make("CartPole-v1", max_episode_steps=7)

    env = make_vec_env(["CartPole-v1", short], wrapper_class=TenTimes, transport="inproc", monitor=False)
    env.seed(1), env.reset()
    ends = [env.step(np.array([t % 2] * 2)) for t in range(7)]
    assert ends[0][1].tolist() == [10.0, 10.0]
    assert ends[6][2].tolist() == [False, True]
    env.close()


def test_samples_of_the_action_space_are_those_of_the_seed() -> None:
    """DQN, SAC and TD3 of Stable-Baselines3 draw their first actions from it."""
    ours = make_vec_env("CartPole-v1", 2, seed=4, monitor=False, transport="inproc")
    theirs = env_util.make_vec_env("CartPole-v1", 2, seed=4)
    assert [ours.action_space.sample() for _ in range(20)] == [theirs.action_space.sample() for _ in range(20)]
    ours.close(), theirs.close()


def test_each_agent_is_a_row_where_all_act_at_every_step() -> None:
    env, loops, draw = make_vec_env(RandomTeam, 2, monitor=False, transport="inproc"), [], np.random.default_rng(1)
    env.seed(5)
    seen: Any = env.reset()
    for n, seed in enumerate((5, 6)):
        loops.append(seated(RandomTeam(), "it"))
        first, _ = loops[-1].reset(seed=seed)
        assert bit_equal([*seen[n * A : n * A + A]], first.observations)
    for _ in range(40):
        action = draw.integers(0, 3, 2 * A)
        seen, reward, done, infos = env.step(action)
        for n, loop in enumerate(loops):
            rows, (last, _, over, _, _) = slice(n * A, n * A + A), loop.step(action.reshape(2, A)[n])
            cut = (np.array(last.truncated) & ~np.array(last.terminated)).tolist()
            told: list[dict[str, Any]] = [{"steps": loop.env.steps, "TimeLimit.truncated": each} for each in cut]
            if over:
                told = [info | {"terminal_observation": last.observations[k].copy()} for k, info in enumerate(told)]
            assert bit_equal([*seen[rows]], (loop.reset()[0] if over else last).observations)
            assert bit_equal(reward[rows], np.array(last.reward, np.float32))
            assert done[rows].tolist() == [over] * A
            assert [dict(sorted(info.items())) for info in infos[rows]] == [dict(sorted(info.items())) for info in told]
    env.set_attr("level", 4, indices=[1, 2])
    assert env.get_attr("level") == [4] * A + [1] * A
    env.close()


@pytest.mark.parametrize("make", [RandomCrowd, RandomGame])
def test_agents_that_do_not_act_at_every_step_are_refused(make: Any) -> None:
    env = make_vec_env(make, 2, seed=1, transport="inproc")
    with pytest.raises(UsageError, match=r"expected all agents to act at every step, but [abc] does not; for agents that"):
        env.reset()
        for _ in range(40):
            env.step(np.zeros(2 * A, np.int64))
    env.close()


def test_a_wrapper_of_gymnasiums_is_refused_with_agents() -> None:
    with pytest.raises(UsageError, match=r"wrapper_class: expected none with agents; pass PettingZoo wrappers as wrappers="):
        make_vec_env(RandomTeam, 2, wrapper_class=TenTimes, transport="inproc")


def test_another_autoreset_mode_is_refused() -> None:
    with (
        millrace.make_vec("CartPole-v1", 2, transport="inproc") as env,
        pytest.raises(UsageError, match="expected autoreset_mode SameStep, got NextStep"),
    ):
        Sb3VecEnv(env)


def test_the_spec_and_the_spaces_are_those_that_a_worker_described() -> None:
    env = make_vec_env("CartPole-v1", 2, monitor=False, workers=1)
    assert [spec.id for spec in env.get_attr("spec")] == ["CartPole-v1"] * 2
    assert env.get_attr("action_space", indices=[1]) == [env.action_space]
    env.close()
