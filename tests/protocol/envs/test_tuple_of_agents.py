"""`TupleOfAgents`: elements of tuples are agents; and the line that names it to whoever trains them as one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.answers import WrongAnswer
from millrace.protocol.envs.seats import SeatedEnv
from millrace.protocol.errors import EnvironmentFailed, UsageError
from tests.support.in_process.collectors import collect, random_collector, run_of
from tests.support.users_code.tuple_envs import Lamps

LAMPS = "tests.support.users_code.tuple_envs:Lamps-v0"
WRAPPER = "millrace:TupleOfAgents"


def test_what_agents_do_and_get_is_what_the_environment_takes_and_returns() -> None:
    plain, wrapped = Lamps(3), millrace.TupleOfAgents(Lamps(3))
    plain.reset(seed=1)
    by_agent, _ = wrapped.reset(seed=1)
    plain.action_space.seed(1)
    assert list(by_agent) == wrapped.agents == wrapped.possible_agents == ["agent_0", "agent_1", "agent_2"]
    over = False
    while not over:
        action = plain.action_space.sample()
        observation, reward, terminated, truncated, _ = plain.step(action)
        found = wrapped.step(dict(zip(wrapped.possible_agents, action, strict=True)))
        over = terminated or truncated
        assert all((ours == theirs).all() for ours, theirs in zip(found[0].values(), observation, strict=True))
        assert list(found[1].values()) == reward
        assert set(found[2].values()) == {terminated}
        assert set(found[3].values()) == {truncated}
        assert wrapped.agents == ([] if over else wrapped.possible_agents)


def test_an_id_in_the_wrapper_has_a_seat_for_each_agent() -> None:
    env = EnvSpec.of(LAMPS, {"agents": 3}, [WRAPPER]).make()
    assert isinstance(env, SeatedEnv)
    assert env.seats == ("agent_0", "agent_1", "agent_2")
    assert env.action_space == Lamps().action_space[0]
    assert not env.takes_turns


@pytest.mark.parametrize("rewards", ["list", "array"])
def test_without_it_a_reward_for_each_element_is_answered_with_the_wrapper(rewards: str) -> None:
    run = run_of(LAMPS, kwargs={"rewards": rewards})
    with pytest.raises(EnvironmentFailed) as caught:
        collect(random_collector(run), run)
    assert str(caught.value) == (
        "lane 0, copy 0, step 0: reward: expected a number, got one for each of 2 elements of its Tuple spaces; if these "
        f"are agents, add --wrappers {WRAPPER}"
    )


def test_a_tuple_of_one_agent_is_one_action() -> None:
    run = run_of(LAMPS, kwargs={"rewards": "sum"})
    (rollout,) = collect(random_collector(run), run)
    assert rollout.action.shape == (8, 2, 4)
    assert np.ptp(rollout.reward) > 0


def test_one_reward_for_all_agents_is_named() -> None:
    env = millrace.TupleOfAgents(Lamps(2, "sum"))
    env.reset(seed=1)
    action = dict(zip(env.possible_agents, Lamps().action_space.sample(), strict=True))
    with pytest.raises(WrongAnswer, match=r"^reward: expected one for each of 2 agents, got -?\d"):
        env.step(action)


class Ending(Lamps):
    """Returns these flags in each step, and an info with a mask in each reset and step."""

    def __init__(self, terminated: Any, truncated: Any) -> None:
        super().__init__()
        self._flags = terminated, truncated
        self.told = {"action_mask": np.array([1, 0, 1], np.int8)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return super().reset(seed=seed)[0], self.told

    def step(self, action: Any) -> Any:
        return *super().step(action)[:2], *self._flags, self.told


@pytest.mark.parametrize(
    ("terminated", "truncated", "expected"),
    [
        (True, False, ([True, True], [False, False])),
        (True, True, ([True, True], [True, True])),
        (np.array([False]), np.array([True]), ([False, False], [True, True])),
        ([True, False], [False, True], ([True, False], [False, True])),
        ((True, True), (False, True), ([True, True], [False, True])),
        (np.array([True, False]), np.array([True, False]), None),
        ([True, False], False, None),
        (False, [False, True], None),
    ],
)
def test_an_episode_ends_once_each_agent_is_terminated_or_truncated(terminated: Any, truncated: Any, expected: Any) -> None:
    env = millrace.TupleOfAgents(Ending(terminated, truncated))
    env.reset(seed=1)
    action = dict(zip(env.possible_agents, Lamps().action_space.sample(), strict=True))
    flags = [list(by_agent.values()) for by_agent in env.step(action)[2:4]]
    assert flags == list(expected or ([False, False], [False, False]))
    assert env.agents == ([] if expected else env.possible_agents)


class Leaving(Lamps):
    """Sets each agent's flag only in the agent's last step: agent 0 is terminated in step 1, agent 1 truncated in step 2."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self._steps = 0
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        self._steps += 1
        return *super().step(action)[:2], [self._steps == 1, False], [False, self._steps == 2], {}


def test_an_agent_whose_flag_was_set_only_once_stays_ended_until_the_reset() -> None:
    env = millrace.TupleOfAgents(Leaving())
    action = dict(zip(env.possible_agents, Lamps().action_space.sample(), strict=True))
    for _ in range(2):  # the second episode, too, ends in its step 2, not before
        env.reset(seed=1)
        flags = [[list(by_agent.values()) for by_agent in env.step(action)[2:4]] for _ in range(2)]
        assert flags == [[[False, False], [False, False]], [[True, False], [False, True]]]
        assert env.agents == []


def test_each_agent_gets_the_info_of_a_reset_and_of_a_step() -> None:
    plain = Ending(False, False)
    env = millrace.TupleOfAgents(plain)
    infos = [env.reset(seed=1)[1]]
    infos.append(env.step(dict(zip(env.possible_agents, Lamps().action_space.sample(), strict=True)))[4])
    assert infos == [{"agent_0": plain.told, "agent_1": plain.told}] * 2


class Uneven(Lamps):
    """Has an observation less than actions."""

    def __init__(self) -> None:
        super().__init__(3)
        self.observation_space = Lamps(2).observation_space


@pytest.mark.parametrize("make", [lambda: gymnasium.make("CartPole-v1"), Uneven])
def test_other_spaces_are_refused(make: Any) -> None:
    with pytest.raises(
        UsageError, match=r"^TupleOfAgents: expected an observation space and an action space that are Tuples"
    ):
        millrace.TupleOfAgents(make())
