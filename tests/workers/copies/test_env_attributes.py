"""Attributes of env copies: who gets them, in which order they are set, and what is refused."""

from __future__ import annotations

from typing import Any

import gymnasium
import pytest
from gymnasium.vector import SyncVectorEnv
from pettingzoo.utils.wrappers import BaseWrapper

from millrace.extras.envs.vector_copies import VectorCopies
from millrace.protocol.envs.seats import seated
from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.wire.plain_values import pack
from millrace.workers.copies.env_copies import EnvCopies, LoopedCopies
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.seated_copies import SeatedCopies
from tests.support.in_process.collectors import collect, no_pulse, random_collector, run_of
from tests.support.users_code.fact_envs import Facts
from tests.support.users_code.seat_envs import AGENTS, RandomGame

FACTS = "tests.support.users_code.fact_envs:Facts-v0"


class Named(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Has an attribute of its own, and one that accepts only small values."""

    mine = 0

    @property
    def small(self) -> int:
        return 0

    @small.setter
    def small(self, value: int) -> None:
        if value > 3:
            raise ValueError("too large")


def made(vector: bool) -> tuple[EnvCopies, list[Any]]:
    envs = [Named(Facts()) for _ in range(2)]
    makes = [lambda env=env: env for env in envs]
    if vector:
        return VectorCopies(SyncVectorEnv(makes)), envs
    return LoopedCopies(makes, no_pulse), envs


@pytest.mark.parametrize("vector", [False, True])
def test_the_outermost_that_has_the_attribute_gets_it(vector: bool) -> None:
    copies, envs = made(vector)
    copies.assign("level", pack([1, 2]), no_pulse)
    copies.assign("mine", pack(5), no_pulse)
    assert [env.unwrapped.level for env in envs] == [[1, 2], [1, 2]]
    assert envs[0].unwrapped.level is not envs[1].unwrapped.level, "each copy has a value of its own"
    assert [env.mine for env in envs] == [5, 5]
    assert not hasattr(envs[0].unwrapped, "mine")
    assert "level" not in vars(envs[0])


@pytest.mark.parametrize("vector", [False, True])
@pytest.mark.parametrize(("name", "what"), [("levle", "none"), ("step", "a method"), ("__dict__", "a private one")])
def test_an_attribute_that_is_not_there_is_refused(vector: bool, name: str, what: str) -> None:
    copies, _ = made(vector)
    with pytest.raises(CopyFailed) as caught:
        copies.assign(name, pack(1), no_pulse)
    assert caught.value.line == f"expected an attribute of the environment that is called {name}, got {what}"


def test_with_seats_pettingzoos_environment_gets_it_or_its_wrapper_if_that_has_it() -> None:
    env = BaseWrapper(RandomGame())
    copies = SeatedCopies([lambda: seated(env, "it")], no_pulse, AGENTS)
    copies.assign("level", pack(7), no_pulse)
    assert env.env.level == 7
    assert "level" not in vars(env)
    with pytest.raises(CopyFailed, match="levle, got none"):
        copies.assign("levle", pack(7), no_pulse)


def test_what_a_setter_raises_is_the_environment_s() -> None:
    copies, _ = made(vector=False)
    with pytest.raises(CopyFailed) as caught:
        copies.assign("small", pack(4), no_pulse)
    assert isinstance(caught.value.__cause__, ValueError)


def test_attributes_are_set_before_the_first_reset_and_only_when_they_change() -> None:
    told: list[Any] = []

    class Tells(Facts):
        def reset(self, **keywords: Any) -> Any:
            told.append("reset")
            return super().reset(**keywords)

        @property
        def level(self) -> float:
            return 0.0

        @level.setter
        def level(self, value: float) -> None:
            told.append(value)

    run = run_of(FACTS, T=2, N=1)
    collector = random_collector(run, lambda run, lane, pulse: LoopedCopies([Tells], pulse))
    collector.env_attributes = pack({"level": 2.0})
    for k in range(3):
        collect(collector, run, k)
    assert told[:3] == [0.0, 2.0, "reset"], "0.0 is that of the constructor"
    assert told.count(2.0) == 1
    collector.env_attributes = pack({"level": 3.0})
    collect(collector, run, 3)
    assert told.count(3.0) == 1
    collect(collector, run, 0, incarnation=1)
    assert told[-2:] == [3.0, "reset"], "a lane that starts on new copies"


def test_a_lane_names_the_attribute() -> None:
    run = run_of(FACTS)
    collector = random_collector(run)
    collector.env_attributes = pack({"levle": 2.0})
    with pytest.raises(
        EnvironmentFailed, match="lane 0, copy 0, set_env_attr levle: expected an attribute of the environment"
    ):
        collect(collector, run)
