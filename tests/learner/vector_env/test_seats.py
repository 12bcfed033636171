"""A vector environment with seats is, to the bit, what a loop over `protocol/envs/seats.py` is, in any order and mode."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from pettingzoo.utils.wrappers import BaseParallelWrapper, BaseWrapper

import millrace
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.learner.vector_env.infos import OfSomeRows
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.envs.seats import SeatedEnv, SeatStep, seated, side_by_side
from millrace.protocol.errors import EnvironmentFailed, UsageError
from tests.support.in_process.any_order import AnyOrder, any_order
from tests.support.in_process.rows_of_copies import info_of
from tests.support.numbers.bit_equality import bit_equal
from tests.support.users_code.seat_envs import AGENTS, RandomCrowd, RandomGame, RandomTeam

FORMS: dict[str, Any] = {"turns": RandomGame, "together": RandomCrowd}
MODES = tuple(AutoresetMode)
A, N = len(AGENTS), 3
BOTH_FORMS = pytest.mark.parametrize("form", FORMS)
BOTH_WAYS = pytest.mark.parametrize("shared", [True, False], ids=["shared memory", "messages"])
EACH_MODE = pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.value)
Rows = tuple[Any, ...]
"""Observations, rewards, ends, and the infos of each row."""


class Loop:
    """The plain loop over one copy, with autoreset as gymnasium has it."""

    def __init__(self, env: Any, mode: AutoresetMode) -> None:
        self.env: SeatedEnv = seated(env, "it")
        self.mode, self.over = mode, False

    def reset(self, seed: int | None = None) -> SeatStep:
        self.over = False
        return self.env.reset(seed=seed)[0]

    def step(self, actions: Any) -> SeatStep:
        if self.over and self.mode is AutoresetMode.NEXT_STEP:
            return self.reset()
        last, _, self.over, _, _ = self.env.step(actions)
        if not self.over or self.mode is not AutoresetMode.SAME_STEP:
            return last
        last = deepcopy(last)  # the reset may overwrite it
        first = self.reset()
        ends = zip(last.observations, last.infos, first.infos, strict=True)
        infos: list[Any] = [{"final_obs": seen, "final_info": info, **new} for seen, info, new in ends]
        outside = [a + b for a, b in zip(last.outside, first.outside, strict=True)]
        return last._replace(observations=first.observations, infos=infos, acts=first.acts, outside=outside)


def rows_of(steps: Iterable[SeatStep]) -> Rows:
    """What these steps of copies are in a batch."""
    found, infos = side_by_side(steps), dict[str, Any]()
    rows = range(len(found.acts))
    for row, info in enumerate(found.infos):
        infos = OfSomeRows(len(rows))._add_info(infos, dict(info), row)
    for name in ("acts", "complete", "outside"):
        infos |= {name: np.array(getattr(found, name)), f"_{name}": np.ones(len(rows), bool)}
    numbers = np.array(found.reward, np.float64), np.array(found.terminated), np.array(found.truncated)
    return np.stack(found.observations), *numbers, [info_of(infos, row) for row in rows]


def told(result: Rows) -> Rows:
    """The same of what `step` or `recv` returns."""
    *arrays, infos = result
    return *arrays, [info_of(infos, row) for row in range(len(arrays[0]))]


def first_rows(steps: Iterable[SeatStep]) -> Rows:
    """What `reset` returns of them."""
    observation, *_, infos = rows_of(steps)
    return observation, infos


@contextmanager
def made(form: str, *, shared: bool = True, lanes: int = N, **changes: Any) -> Iterator[tuple[ZmqVectorEnv, AnyOrder]]:
    """A vector environment whose workers do what the test says."""
    env = f"tests.support.users_code.seat_envs:{FORMS[form].__name__}"
    with any_order(VectorEnvSettings(env, N, lanes=lanes, **changes), lanes, shared=shared) as pair:
        yield pair


@BOTH_FORMS
@EACH_MODE
def test_the_rows_of_all_steps_are_those_of_a_loop(form: str, mode: AutoresetMode) -> None:
    draw, ended = np.random.default_rng(3), 0
    with made(form, shared=False, lanes=2, autoreset_mode=mode) as (env, _):
        loops = [Loop(FORMS[form](), mode) for _ in range(N)]
        assert bit_equal(told(env.reset(seed=4)), first_rows(loop.reset(4 + n) for n, loop in enumerate(loops)))
        for t in range(150):
            actions = draw.integers(0, 3, N * A)
            found = told(env.step(actions))
            expected = rows_of(loop.step(actions.reshape(N, A)[n]) for n, loop in enumerate(loops))
            assert bit_equal(found, expected), f"step {t}: {found} is not {expected}"
            over = [n for n, loop in enumerate(loops) if loop.over]
            ended += len(over)
            if over and mode is AutoresetMode.DISABLED:
                with pytest.raises(UsageError, match=r"copies .* have ended"):
                    env.step(actions)
                env.reset_async(env_ids=over)
                *arrays, infos = env.recv(len(over))
                assert infos.pop("env_id").tolist() == over
                assert bit_equal(told((*arrays, infos)), rows_of([loops[n].reset() for n in over]))
        assert mode is AutoresetMode.SAME_STEP or ended > 10


@BOTH_FORMS
@BOTH_WAYS
def test_each_copy_has_the_same_rows_when_lanes_do_not_wait_for_each_other(form: str, shared: bool) -> None:
    draw = np.random.default_rng(5)
    with made(form, shared=shared) as (env, link):
        link.choose = lambda count: int(draw.integers(count))
        loops = [Loop(FORMS[form](), AutoresetMode.NEXT_STEP) for _ in range(N)]
        env.reset_async(seed=4)
        waiting: dict[int, SeatStep] = {n: loop.reset(4 + n) for n, loop in enumerate(loops)}
        for _ in range(200):
            *arrays, infos = env.recv()
            copies = infos.pop("env_id").tolist()
            assert bit_equal(told((*arrays, infos)), rows_of(waiting.pop(n) for n in copies))
            copies = copies[::-1]
            actions = draw.integers(0, 3, (len(copies), A))
            waiting |= {n: loops[n].step(of_copy) for n, of_copy in zip(copies, actions, strict=True)}
            env.send(actions.ravel(), copies)
        assert {len(loop.env.env.told) > 5 for loop in loops} == {True}


@BOTH_WAYS
@EACH_MODE
def test_all_rows_of_a_lost_copy_are_truncated_and_none_is_complete(shared: bool, mode: AutoresetMode) -> None:
    with made("turns", shared=shared, autoreset_mode=mode) as (env, link):
        before, _ = env.reset(seed=1)
        link.frozen = {"w1"}
        env.step_async(np.zeros(N * A, np.int64))
        link.leave("w1")
        seen, reward, _, truncated, infos = env.step_wait()
        lost, of_lost = np.repeat([False, True, False], A), slice(A, 2 * A)
        assert truncated[of_lost].all()
        assert not reward[of_lost].any()
        assert infos["worker_lost"].tolist() == lost.tolist()
        assert not infos["complete"][of_lost].any()
        if mode is AutoresetMode.SAME_STEP:
            assert bit_equal(np.stack(infos["final_obs"][of_lost].tolist()), before[of_lost])
            assert infos["acts"][of_lost].any(), "of the new copy"
            return
        assert bit_equal(seen[of_lost], before[of_lost])
        assert not infos["acts"][of_lost].any()
        if mode is AutoresetMode.DISABLED:
            _, infos = env.reset(options={"reset_mask": np.array([False, True, False])})
        else:
            infos = env.step(np.zeros(N * A, np.int64))[-1]
        assert infos["acts"][of_lost].any()
        assert "worker_lost" not in infos


class Passing(BaseWrapper):  # type: ignore[misc]
    """A wrapper of PettingZoo's with an attribute of its own."""

    mine = 5

    def greet(self, name: str) -> str:
        return f"hello {name}"


class PassingParallel(BaseParallelWrapper):  # type: ignore[misc]
    """The same for the other form."""

    mine, greet = Passing.mine, Passing.greet


@pytest.mark.parametrize("make", [lambda: Passing(RandomGame()), lambda: PassingParallel(RandomCrowd())])
def test_attributes_are_of_copies_and_found_in_their_wrappers(make: Any) -> None:
    with millrace.make_vec(make, N, transport="inproc") as env:
        assert env.get_attr("level") == (1,) * N
        env.set_attr("level", [1, 2, 3])
        env.set_attr("mine", [6, 7, 8])
        assert env.get_attr("level") == (1, 2, 3)
        assert env.get_attr("mine") == (6, 7, 8)
        assert env.call("greet", "you") == ("hello you",) * N
        assert env.call("has_wrapper_attr", "level") == (True,) * N
        with pytest.raises(AttributeError, match="no_such_thing"):
            env.get_attr("no_such_thing")
        with pytest.raises(ValueError, match="values: expected one for each of 3 copies, got 9"):
            env.set_attr("level", [1] * N * A)


class Turning(RandomCrowd):
    """Its actions are dicts, which it remembers."""

    def __init__(self) -> None:
        super().__init__()
        for agent, (seen, _) in self._spaces.items():
            self._spaces[agent] = seen, spaces.Dict({"left": spaces.Box(-1, 1, (2,)), "right": spaces.Discrete(3)})

    def _act(self, agent: str, seen: Any, action: Any) -> None:
        super()._act(agent, seen, action["right"])
        self.did = {**getattr(self, "did", {}), agent: action["left"]}


def test_nested_observations_and_actions() -> None:
    with millrace.make_vec(Turning, 2, transport="inproc", wrappers=["millrace.protocol.envs.seats:seat_id"]) as env:
        observation, infos = env.reset(seed=2)
        assert observation["seat"].tolist() == [*range(A)] * 2
        actions = env.action_space.sample()
        acted = infos["acts"].reshape(2, A)
        env.step(actions)
        for n, did in enumerate(env.get_attr("did")):
            assert list(did) == [agent for seat, agent in enumerate(AGENTS) if acted[n, seat]]
            for agent, left in did.items():
                assert bit_equal(left, actions["left"][n * A + AGENTS.index(agent)])


class Long(RandomTeam):
    """The first observation of agent b is as its space says, the others are longer."""

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        seen, *rest = super().step(actions)
        return seen | {"b": np.zeros(2, np.float32)}, *rest


class Empty(Long):
    """Its observations are dicts, and those of agent b lack their leaf."""

    def __init__(self) -> None:
        super().__init__()
        for agent, (seen, action) in self._spaces.items():
            self._spaces[agent] = spaces.Dict({"x": seen}), action

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        seen, infos = super().reset(seed, options)
        return {agent: {"x": value} for agent, value in seen.items()}, infos

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        seen, *rest = super().step(actions)
        return {agent: {} if agent == "b" else {"x": value} for agent, value in seen.items()}, *rest


@pytest.mark.parametrize(
    ("make", "what"), [(Long, r"observation: expected float32\[1\]"), (Empty, "observation: expected the str")]
)
def test_a_wrong_observation_is_named_by_its_copy_and_agent(make: Any, what: str) -> None:
    with millrace.make_vec(make, 2, transport="inproc", lanes=1) as env:
        env.reset()
        with pytest.raises(EnvironmentFailed, match=f"lane 0, copy 0, step 0: b, {what}"):
            env.step(np.zeros(2 * A, np.int64))


class Wide(RandomGame):
    """One copy sees other bounds than another."""

    made = 0

    def __init__(self) -> None:
        super().__init__()
        Wide.made += 1
        high = np.float32(10 + Wide.made)
        for agent, (_, action) in self._spaces.items():
            self._spaces[agent] = spaces.Box(0, high, (1,), np.float32), action


def test_its_spaces_have_a_row_for_each_seat() -> None:
    with millrace.make_vec(RandomGame, N, transport="inproc") as env:
        assert (env.num_envs, env.seats) == (N * A, AGENTS)
        assert env.single_observation_space == RandomGame().observation_space("a")
        assert env.observation_space.shape == (N * A, 1)
        assert env.action_space == spaces.MultiDiscrete([3] * N * A)
        with pytest.raises(ValueError, match="actions: expected one for each of 9 rows, got shape"):
            env.step([0] * N)
    with millrace.make_vec(Wide, 2, transport="inproc", observation_mode="different") as env:
        of_copies = env.observation_space.high.reshape(2, A)  # type: ignore[attr-defined]
        assert (of_copies == of_copies[:, :1]).all()
        assert of_copies[0, 0] != of_copies[1, 0]


class Pair(RandomGame):
    """It has other agents."""

    possible_agents = AGENTS[:2]


def test_copies_with_other_agents_are_refused() -> None:
    why = r"copy 1: expected agents \['a', 'b', 'c'\] as copy 0 has, got \['a', 'b'\]"
    with pytest.raises(EnvironmentFailed, match=why):
        millrace.make_vec([RandomGame, Pair], transport="inproc")


@BOTH_FORMS
def test_processes_give_the_same_bits(form: str) -> None:
    draw = np.random.default_rng(3)
    with (
        millrace.make_vec(FORMS[form], N, workers=2) as one,
        millrace.make_vec(FORMS[form], N, workers=1, shared_memory=False) as other,
    ):
        assert bit_equal(one.reset(seed=2), other.reset(seed=2))
        for _ in range(50):
            actions = draw.integers(0, 3, N * A)
            assert bit_equal(one.step(actions), other.step(actions))


class Plain(RandomGame):
    """PettingZoo's test counts rewards from the first step on."""

    rewards_at_reset = 0.0


def test_the_environments_of_these_tests_are_pettingzoos() -> None:
    """So what is compared above is what users have.

    PettingZoo's tests cannot take a `ZmqVectorEnv`, which has another form. Of what they check, this holds for it too, by
    the comparison above: seeds and actions decide everything, and agents that left have no rows before the next episode.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # observations of one number, rewards of agents that left
        from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

        api_test(Plain(), num_cycles=200)
        seed_test(Plain, num_cycles=200)
        for together in (RandomCrowd, Turning):
            parallel_api_test(together(), num_cycles=200)
            parallel_seed_test(together, num_cycles=200)
