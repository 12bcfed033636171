"""What an environment of several agents returns wrongly is named, by what it is and by agent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from millrace.protocol.arrays import Array
from millrace.protocol.envs.answers import WrongAnswer
from millrace.protocol.envs.seats import seat_id, seated, with_state
from millrace.protocol.errors import UsageError
from tests.support.users_code.seat_envs import RockPaperScissors


class Wrong(RockPaperScissors):
    """Calls its agents otherwise in the part that is called `wrong`, or returns `instead`."""

    def __init__(self, wrong: str, instead: Any = None) -> None:
        super().__init__()
        self.wrong, self.instead = wrong, instead

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        observations, infos = super().reset()
        if self.wrong == "agents":
            self.agents = [*self.agents, "middle"]
        return self.other("reset", observations), infos

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        found = super().step(actions)
        if self.wrong == "agents later":
            self.agents = ["middle"]
        return tuple(map(self.other, ("observations", "rewards", "terminated", "truncated", "infos"), found))

    def other(self, what: str, found: dict[str, Any]) -> Any:
        renamed = {agent.upper(): each for agent, each in found.items()}
        return found if what != self.wrong else renamed if self.instead is None else self.instead


@pytest.mark.parametrize(
    ("wrong", "instead", "says"),
    [
        ("reset", None, "observations: expected agent left among them, got LEFT, RIGHT"),
        ("agents", None, "agents: expected some of possible_agents, got middle"),
        ("agents later", None, "agents: expected some of possible_agents, got middle"),
        ("rewards", None, "rewards: expected agent left among them, got LEFT, RIGHT"),
        ("rewards", 1.0, "rewards: expected a dict by agent, got float"),
        ("terminated", True, "terminated: expected a dict by agent, got bool"),
        ("truncated", {}, "truncated: expected agent left among them, got none"),
    ],
)
def test_what_is_wrong_is_named(wrong: str, instead: Any, says: str) -> None:
    env = seated(Wrong(wrong, instead), "game")
    with pytest.raises(WrongAnswer) as caught:
        env.reset(seed=1)
        env.step([0, 0])
    assert str(caught.value) == says


def test_the_last_observation_of_a_task_that_has_ended_may_be_missing() -> None:
    env = seated(Wrong("observations", {}), "game")
    env.reset(seed=1)
    assert env.step([0, 0])[2]


class Stated(RockPaperScissors):
    """Has a state without a space."""

    def __init__(self, state: Array) -> None:
        super().__init__()
        self._state = state

    def state(self) -> Array:
        return self._state


def test_a_state_without_a_space_has_no_bounds() -> None:
    seen: Any = seated(with_state(Stated(np.zeros(2, np.float32))), "Stated").observation_space
    space = seen["state"]
    assert (space.shape, space.dtype, space.is_bounded()) == ((2,), np.float32, False)


@pytest.mark.parametrize("dtype", [np.uint8, bool, object])
def test_a_state_whose_dtype_does_not_say_what_it_means_needs_a_space(dtype: Any) -> None:
    with pytest.raises(UsageError, match=r"Stated: critic_keys state: .* got .*; give the environment a state_space"):
        seated(with_state(Stated(np.zeros(2, dtype))), "Stated")


def test_a_state_that_is_no_method_is_none() -> None:
    env = Stated(np.zeros(2))
    env.state = {"left": 0}  # type: ignore[assignment, method-assign]
    with pytest.raises(UsageError, match=r"critic_keys state: expected a method state\(\), got none"):
        seated(with_state(env), "Stated")


class Crumbles(Stated):
    """Has no state after its end, because its parts are gone."""

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        found = super().step(actions)
        self._over = any(found[2].values())
        return found

    def state(self) -> Array:
        assert not getattr(self, "_over", False), "its parts are gone"
        return self._state


def test_a_terminated_agent_is_shown_the_state_before_its_end() -> None:
    env = seated(with_state(Crumbles(np.full(2, 5.0, np.float32))), "Crumbles")
    env.reset(seed=1)
    step, _, over, _, _ = env.step([0, 0])
    assert over
    assert all(step.terminated)
    assert [seen["state"].tolist() for seen in step.observations] == [[5, 5], [5, 5]]


class OwnParts(RockPaperScissors):
    """Its observations have parts whose names settings add, too."""

    def observation_space(self, agent: str) -> Any:
        return spaces.Dict({"seat": spaces.Discrete(5), "state": spaces.Box(-9, 9, (3,), np.float32)})

    def state(self) -> Array:
        return np.zeros(1)


def test_a_part_of_the_observation_called_state_is_the_one_that_the_critic_sees() -> None:
    assert seated(with_state(OwnParts()), "Own").observation_space == OwnParts().observation_space("left")


def test_a_part_of_the_observation_called_seat_is_not_replaced() -> None:
    with pytest.raises(UsageError, match="environment Own: seat_id: its observations have a part 'seat' of their own"):
        seated(seat_id(OwnParts()), "Own")


def test_a_reward_may_be_an_array_of_one_number() -> None:
    env = seated(Wrong("rewards", {agent: np.full(1, 2.5) for agent in RockPaperScissors().possible_agents}), "game")
    env.reset(seed=1)
    assert env.step([0, 0])[0].reward == [2.5, 2.5]


def test_a_wrong_reward_is_named_although_those_before_it_are_arrays_of_one_number() -> None:
    env = seated(Wrong("rewards", {"left": np.full(1, 2.5), "right": "much"}), "game")
    env.reset(seed=1)
    with pytest.raises(WrongAnswer, match=r"^reward of agent right: expected a number, got 'much'$"):
        env.step([0, 0])


class InsideOut:
    """A parallel view of an environment, as PettingZoo's `parallel_wrapper_fn` makes it: it forwards nothing."""

    def __init__(self, env: Any) -> None:
        self.aec_env = env


def test_the_attributes_of_an_environment_below_a_parallel_view_are_found() -> None:
    env = seated(Stated(np.zeros(2)), "Stated")
    inner = env.env
    inner.level = 3
    env.env = InsideOut(inner)
    assert env.owner("level") is inner
    assert env.get_wrapper_attr("level") == 3
    assert not env.has_wrapper_attr("nothing")
