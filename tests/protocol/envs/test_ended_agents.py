"""An agent whose part has ended is out until the reset, whatever `agents` says; and what turns return wrongly is named."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from millrace.protocol.envs.answers import WrongAnswer
from millrace.protocol.envs.seats import SeatedEnv, SeatStep, seated

A, B = 0, 1


class Pair:
    """Two agents. `a` ends in step 2, and the episode in step 5."""

    possible_agents = ("a", "b")
    metadata: Mapping[str, Any] = {}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(0, 9, (1,), np.float32)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(2)


class Together(Pair):
    """Lists `a` after its end in the steps `listed`, and rewards it then."""

    def __init__(self, listed: range, *, ends_again: bool = False) -> None:
        self.listed, self.ends_again = listed, ends_again
        self.given: list[list[str]] = []

    def reset(self, seed: int | None = None) -> Any:
        self.t, self.agents = 0, ["a", "b"]
        return self._seen(), {}

    def _seen(self) -> dict[str, Any]:
        return {agent: np.full(1, self.t, np.float32) for agent in "ab"}

    def step(self, actions: dict[str, Any]) -> Any:
        self.t += 1
        self.given.append(list(actions))
        a_ends = self.t == 2 or (self.ends_again and self.t > 2)
        self.agents = ["a", "b"] if self.t < 2 or self.t in self.listed else ["b"]
        if self.t == 5 and self.t not in self.listed:
            self.agents = []
        return self._seen(), {"a": 1.0, "b": 1.0}, {"a": a_ends, "b": self.t == 5}, {"a": False, "b": False}, {}


def played(env: SeatedEnv, steps: int = 5) -> list[SeatStep]:
    env.reset(seed=1)
    found = []
    for t in range(steps):
        step, _, over, _, _ = env.step([0, 0])
        found.append(step)
        assert over == (t == 4)
    return found


@pytest.mark.parametrize("ends_again", [False, True])
@pytest.mark.parametrize(
    "listed", [range(9), range(4, 9), range(2, 4), range(0)], ids=["stays", "comes back", "a while", "leaves"]
)
def test_an_agent_that_has_ended_acts_no_more_and_its_rewards_are_its_return_s(listed: range, ends_again: bool) -> None:
    env = Together(listed, ends_again=ends_again)
    made = seated(env, "it")
    for _ in range(2):  # after the reset it is there again
        env.given.clear()
        steps = played(made)
        assert env.given == [["a", "b"]] * 2 + [["b"]] * 3
        assert [step.complete[A] for step in steps] == [True, True, False, False, False]
        assert [step.acts[A] for step in steps] == [True, False, False, False, False]
        assert [step.reward[A] for step in steps] == [1, 1, 0, 0, 0]
        assert [step.outside[A] for step in steps] == [0, 0, 1, 1, 1]
        assert [step.terminated[A] for step in steps] == [False, True, False, False, False]


class InTurns(Pair):
    """`a` and `b` move in turn. What is `wrong` begins after the end of `a`, which comes after its second move."""

    def __init__(self, wrong: str = "", last: Any = None) -> None:
        self.wrong, self.changes = wrong, last or (lambda answer: answer)

    def agent_iter(self) -> None: ...

    def reset(self, seed: int | None = None) -> None:
        self.moves, self.agents, self.agent_selection = 0, ["a", "b"], "a"
        self.ended = {"a": False, "b": False}

    def last(self) -> Any:
        seen = np.full(1, self.moves, np.float32)
        return self.changes((seen, 1.0, self.ended[self.agent_selection], False, {}))

    def step(self, action: Any) -> None:
        mover = self.agent_selection
        if self.ended[mover]:
            assert action is None
            if self.wrong == "selected for ever":
                return
            if self.wrong != "stays":
                self.agents.remove(mover)
            self.agent_selection = "b"
            return
        self.moves += 1
        self.ended = {"a": self.moves >= 3, "b": self.moves >= 6}
        self.agent_selection = "a" if self.moves in (2, 3) else "b"
        if self.moves == 4 and self.wrong in ("comes back", "ends again"):
            self.agents, self.agent_selection = ["a", "b"], "a"
            self.ended["a"] = self.wrong == "ends again"
        if self.moves == 2 and self.wrong == "a stranger":
            self.ended["c"], self.agent_selection = False, "c"


def all_of(env: Any) -> list[SeatStep]:
    made, found, over = seated(env, "it"), [], False
    found.append(made.reset()[0])
    while not over:
        step, _, over, _, _ = made.step([0, 0])
        found.append(step)
        assert len(found) < 20
    return found


def said_of(env: Any) -> str:
    with pytest.raises(WrongAnswer) as caught:
        all_of(env)
    return str(caught.value)


AGAIN = (
    "agent_selection: expected an agent whose part has not ended, got a again; after its end, step(None) selects another one"
)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("selected for ever", AGAIN),
        ("comes back", AGAIN),
        ("ends again", AGAIN),
        ("a stranger", "agent_selection: expected one of possible_agents, got c"),
    ],
)
def test_turns_of_an_agent_that_has_ended_are_named(wrong: str, says: str) -> None:
    assert said_of(InTurns(wrong)) == says


def test_turns_end_when_nobody_is_left_whom_agents_does_not_list_in_vain() -> None:
    steps = all_of(InTurns("stays"))
    assert [step.complete[B] for step in steps] == [step.complete[B] for step in all_of(InTurns())]
    assert sum(step.terminated[A] for step in steps) == sum(step.terminated[B] for step in steps) == 1


def at(moves: int, **parts: Any) -> Any:
    """Changes what `last` returns after so many moves."""

    def changed(answer: Any) -> Any:
        observation, reward, terminated, truncated, info = answer
        if int(observation[0]) != moves:
            return answer
        named = {"seen": observation, "reward": reward, "terminated": terminated, "truncated": truncated, "info": info}
        return tuple((named | parts).values())

    return changed


@pytest.mark.parametrize(
    ("last", "says"),
    [
        (at(2, seen=None), "agent a: expected an observation unless it is terminated, got None"),
        (at(2, seen=None, truncated=True), "agent a: expected an observation unless it is terminated, got None"),
        (at(1, info=[]), "info of agent b: expected a dict, got list"),
        (at(1, reward="much"), "reward of agent b: expected a number, got 'much'"),
        (at(2, reward=None), "reward of agent a: expected a number, got None"),
        (at(1, reward=10**400), f"reward of agent b: expected a number, got {str(10**400)[:79]}…"),
        (at(2, truncated=np.ones(2)), "truncated of agent a: expected a number, got array([1., 1.])"),
        (
            lambda answer: answer[:4],
            "its last() returned 4 values (float32[1], float, bool, bool); expected "
            "(observation, reward, terminated, truncated, info)",
        ),
    ],
)
def test_what_last_returns_wrongly_is_named(last: Any, says: str) -> None:
    assert said_of(InTurns(last=last)) == says


def test_what_nobody_needs_may_be_missing() -> None:
    """The info, and the last observation of a task that has ended."""
    steps = all_of(InTurns(last=at(6, seen=None, info=None)))
    assert steps[-1].observations[B][0] == 5
    assert all(step.observations[B] is not None for step in steps)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"infos": []}, "infos: expected a dict by agent, got list"),
        ({"infos": {"a": [1]}}, "info of agent a: expected a dict, got list"),
        ({"rewards": {"a": None, "b": 1.0}}, "reward of agent a: expected a number, got None"),
        (
            {"rewards": {"a": 1.0, "b": 10**400}},
            f"reward of agent b: expected a number, got {str(10**400)[:79]}…",
        ),
        ({"rewards": {"a": 1.0, "b": 1.0, "c": 1.0}}, "rewards: expected some of possible_agents, got c"),
        ({"terminated": {"a": False, "b": np.zeros(2)}}, "terminated of agent b: expected a number, got array([0., 0.])"),
    ],
)
def test_what_agents_get_together_is_named_by_agent(changes: dict[str, Any], says: str) -> None:
    class Changed(Together):
        def step(self, actions: dict[str, Any]) -> Any:
            names = ("observations", "rewards", "terminated", "truncated", "infos")
            return tuple((dict(zip(names, super().step(actions), strict=True)) | changes).values())

    assert said_of(Changed(range(0))) == says
    none = {"infos": None} if "infos" in changes else {"infos": {"a": None}}
    changes.clear()
    changes |= none
    all_of(Changed(range(0)))
