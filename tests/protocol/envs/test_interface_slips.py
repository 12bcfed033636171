"""Slips of a first environment: what is no environment, or lacks a part, is one line that says what to write."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import describe_env
from millrace.protocol.envs.seats import MAX_AGENT_NAME
from millrace.protocol.errors import UsageError
from tests.support.envs.toy import Countdown
from tests.support.users_code.seat_envs import RandomCrowd

MODULE = __name__


class OfRLlib(Countdown):
    def __init__(self, config: Any) -> None:
        super().__init__(config.get("k", 3))


class OfRLlibByDefault(Countdown):
    def __init__(self, env_config: Any = None) -> None:
        super().__init__(env_config["k"])


class AsksWhatIsIn(Countdown):
    def __init__(self, config: Any) -> None:
        super().__init__(3 if "k" in config else 4)


class LosesSomethingElse(Countdown):
    def __init__(self, config: Any = None) -> None:
        world: Any = None
        super().__init__(world.get("k"))


def from_entries(**config: Any) -> gymnasium.Env[Any, Any]:
    return OfRLlib(config)


def refusal(name: str, **kwargs: Any) -> str:
    with pytest.raises(UsageError) as caught:
        EnvSpec.of(f"{MODULE}:{name}", kwargs).make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "argument", "says"),
    [
        ("OfRLlib", "config", "AttributeError: 'EnvCopy' object has no attribute 'get'"),
        ("OfRLlibByDefault", "env_config", "TypeError: 'NoneType' object is not subscriptable"),
        ("AsksWhatIsIn", "config", "TypeError: argument of type 'EnvCopy' is not "),
    ],
)
def test_an_environment_that_takes_a_dict_is_told_how_to_get_it(name: str, argument: str, says: str) -> None:
    found = refusal(name)
    assert found.startswith(f"environment {MODULE}:{name}: {says}")
    assert found.endswith(
        f": its argument {argument} is a dict, as RLlib passes it; name a function of your own in place of {MODULE}:{name}: "
        f"def make_env(**config): return {name}(config), and give entries of the dict as --env-kwargs NAME VALUE"
    )


def test_what_it_is_told_works() -> None:
    env = EnvSpec.of(f"{MODULE}:from_entries", {"k": 7}).make()
    env.reset()
    assert [env.step(0)[2] for _ in range(7)] == [False] * 6 + [True]


def test_something_else_that_is_none_is_not_taken_for_the_dict() -> None:
    assert "as RLlib" not in refusal("LosesSomethingElse")
    assert "as RLlib" not in refusal("OfRLlibByDefault", env_config=3)


# -------------------------------------------------------------------------------------------------------- several agents


class SpacesAreAttributes(RandomCrowd):
    observation_space = spaces.Box(0, np.inf, (1,))  # type: ignore[assignment]


class ActionsAreAttributes(RandomCrowd):
    action_space = spaces.Discrete(3)  # type: ignore[assignment]


class KnowsAgentsLater:
    def observation_space(self, agent: str) -> None: ...

    def action_space(self, agent: str) -> None: ...

    def reset(self, **_: Any) -> Any:
        self.agents = self.possible_agents = ["a"]


class ListsAgentsLater(RandomCrowd):
    possible_agents = ()


class OfDmEnv:
    """Has the interface of DeepMind's dm_env."""

    def observation_spec(self) -> None: ...

    def action_spec(self) -> None: ...


class Nothing:
    """No environment at all."""


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("SpacesAreAttributes", "; it needs a method observation_space(agent), which returns the space of this agent"),
        ("ActionsAreAttributes", "; it needs a method action_space(agent), which returns the space of this agent"),
        ("KnowsAgentsLater", "; it needs possible_agents, a list of all agents that there may be, before its first reset"),
        ("OfDmEnv", "return shimmy.DmControlCompatibilityV0(env), or shimmy.BSuiteCompatibilityV0(env) if it is bsuite's"),
        ("Nothing", ", got Nothing"),
    ],
)
def test_what_lacks_a_part_of_pettingzoo_s_interface_is_told_which(name: str, says: str) -> None:
    found = refusal(name)
    assert found.startswith(f"env factory {MODULE}:{name}: expected it to return an environment of gymnasium or PettingZoo")
    assert found.endswith(says)


def loses_its_spaces(env: Any) -> Any:
    return SpacesAreAttributes()


def test_a_wrapper_that_takes_a_part_away_is_told_too() -> None:
    with pytest.raises(UsageError, match=r"got SpacesAreAttributes; it needs a method observation_space\(agent\)"):
        EnvSpec.of(RandomCrowd, wrappers=[loses_its_spaces]).make()


def test_agents_must_be_listed_before_the_reset() -> None:
    assert refusal("ListsAgentsLater").endswith("got none; it must list all agents before its first reset")


class Agents(RandomCrowd):
    """Has these agents."""

    def __init__(self, *agents: Any) -> None:
        super().__init__()
        self.possible_agents = agents
        self._spaces = dict.fromkeys(agents, self._spaces["a"])


LONG = "x" * (MAX_AGENT_NAME - 1)


@pytest.mark.parametrize(
    ("agents", "got"),
    [
        (("a", "a"), "'a' and 'a'"),
        ((1, "1"), "1 and '1'"),
        ((f"{LONG}1", f"{LONG}12"), None),
        ((f"{LONG}ab", f"{LONG}cd"), f"'{LONG[:58]}… and '{LONG[:58]}…"),
        (("\x1b", "\\x1b"), "'\\x1b' and '\\\\x1b'"),
    ],
    ids=str,
)
def test_agents_must_have_different_names(agents: tuple[Any, ...], got: str | None) -> None:
    """Those that metrics and errors have, which are text of bounded length."""
    make = EnvSpec.of(lambda: Agents(*agents)).make
    if got is None:
        assert len(set(describe_env(make()).seats)) == 2
        return
    with pytest.raises(UsageError) as caught:
        make()
    assert f": possible_agents: expected agents of different names, got {got}; names are text, and " in str(caught.value)
