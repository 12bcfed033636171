"""`ResetAhead`: what overlaps, which random numbers an episode has, and what becomes of errors and attributes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, Tuple

from millrace.protocol.envs.seats import seated
from millrace.protocol.envs.tuple_of_agents import TupleOfAgents
from millrace.protocol.errors import UsageError
from millrace.protocol.random_streams import Purpose, env_seed
from millrace.protocol.wire.plain_values import pack
from millrace.workers.copies.env_copies import CopySettings, LoopedCopies
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.env_loop import CANNOT_RESTART
from millrace.workers.copies.reset_ahead import ResetAhead
from millrace.workers.copies.seated_copies import SeatedCopies
from tests.support.in_process.collectors import no_pulse

DEADLINE_S = 20.0


class Traced(gymnasium.Env[Any, Any]):
    """Two steps an episode. Observations are random numbers of the episode's reset and of the instance's steps."""

    made: list[Traced] = []
    resets_wait_for = threading.Event()
    fails = False
    patience_s = DEADLINE_S
    observation_space: gymnasium.Space[Any] = Box(0, 1, (1,), np.float64)
    action_space: gymnasium.Space[Any] = Discrete(2)
    resetting = False  # an instance is being reset
    set_meanwhile = False  # an attribute was set during a reset

    @property
    def level(self) -> int:
        return self._level

    @level.setter
    def level(self, value: int) -> None:
        self._level = value
        self.set_meanwhile |= self.resetting

    def __init__(self) -> None:
        self.closed = False
        self._level = 0
        self.levels: list[int] = []
        self.seeds: list[int | None] = []
        Traced.made.append(self)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.resetting = True
        self.seeds.append(seed)
        if threading.current_thread() is not threading.main_thread():
            assert Traced.resets_wait_for.wait(Traced.patience_s) or Traced.patience_s < DEADLINE_S
            if Traced.fails:
                raise RuntimeError("no reset today")
        self.levels.append(self.level)
        self._left = 2
        self.resetting = False
        return self.np_random.uniform(size=1), {"instance": Traced.made.index(self)}

    def step(self, action: Any) -> Any:
        Traced.resets_wait_for.set()
        self._left -= 1
        return self.np_random.uniform(size=1), 1.0, self._left == 0, False, {}

    def close(self) -> None:
        self.closed = True


class Windy(Traced):
    """Its attribute `wind` exists after the first reset, and `gust` after the first step."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.wind = 0.0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        self.gust = 1.0
        return super().step(action)


class TracedPair(Traced):
    """The same for two agents, which both see everything."""

    observation_space = Tuple([Traced.observation_space] * 2)
    action_space = Tuple([Traced.action_space] * 2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        seen, info = super().reset(seed=seed, options=options)
        return (seen, seen), info

    def step(self, action: Any) -> Any:
        seen, reward, *over_and_info = super().step(action)
        return (seen, seen), [reward, reward], *over_and_info


gymnasium.register("tests/Traced-v0", f"{__name__}:Traced", disable_env_checker=True)
gymnasium.register("tests/Windy-v0", f"{__name__}:Windy", disable_env_checker=True, max_episode_steps=9)
gymnasium.register("tests/TracedPair-v0", f"{__name__}:TracedPair", disable_env_checker=True)


@pytest.fixture(autouse=True)
def _fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Traced, "made", [])
    monkeypatch.setattr(Traced, "fails", False)
    monkeypatch.setattr(Traced, "resets_wait_for", threading.Event())
    Traced.resets_wait_for.set()


def episode(env: gymnasium.Env[Any, Any], seed: int | None = None) -> tuple[int, list[float]]:
    """The instance that played, and all observations."""
    first, info = env.reset(seed=seed)
    return info["instance"], [first.item(), *(env.step(0)[0].item() for _ in range(2))]


def alone(seed: int, episodes: int) -> list[list[float]]:
    env = Traced()
    return [episode(env, seed if n == 0 else None)[1] for n in range(episodes)]


def test_episodes_take_turns_between_two_instances_with_random_numbers_of_their_own() -> None:
    env = ResetAhead(gymnasium.make("tests/Traced-v0"))
    found = [episode(env, 5), *(episode(env) for _ in range(5))]
    env.close()
    assert [instance for instance, _ in found] == [0, 0, 1, 0, 1, 0]
    second_seed = env_seed(5, Purpose.SECOND_INSTANCE)
    first, second = alone(5, 4), alone(second_seed, 2)
    assert [observations for _, observations in found] == [first[0], first[1], second[0], first[2], second[1], first[3]]
    assert all(each.closed for each in Traced.made[:2])


def test_a_reset_runs_while_the_other_instance_steps() -> None:
    env = ResetAhead(gymnasium.make("tests/Traced-v0"))
    episode(env, 1)
    Traced.resets_wait_for.clear()  # only a step lets the reset in the thread end
    for _ in range(3):
        assert len(episode(env)[1]) == 3
        env.instances()  # the reset in the thread has ended, so it saw the step
        Traced.resets_wait_for.clear()
    Traced.resets_wait_for.set()
    env.close()


def test_a_reset_with_a_seed_begins_again_and_prepares_nothing() -> None:
    env = ResetAhead(gymnasium.make("tests/Traced-v0"))
    for seed in (3, 3, 4):
        assert episode(env, seed)[1] == alone(seed, 1)[0]
    assert [len(each.seeds) for each in Traced.made if each.closed or each is env.unwrapped] == [3]
    found = [episode(env, 7), *(episode(env) for _ in range(3))]
    again = [episode(env, 7), *(episode(env) for _ in range(3))]
    env.close()
    assert [observations for _, observations in found] == [observations for _, observations in again]


def test_what_the_prepared_reset_raises_arrives_at_the_next_reset() -> None:
    env = ResetAhead(gymnasium.make("tests/Traced-v0"))
    episode(env, 1)
    Traced.fails = True
    episode(env)
    with pytest.raises(RuntimeError, match="no reset today"):
        env.reset()
    env.close()


def pair() -> gymnasium.Env[Any, Any]:
    """A copy with two agents that resets ahead."""
    return seated(TupleOfAgents(ResetAhead(gymnasium.make("tests/TracedPair-v0"))), "two")


def copies_of(agents: int, restart_episodes: int = 0) -> LoopedCopies:
    """One copy that resets ahead, with one agent or with two in tuples."""
    settings = CopySettings(restart_episodes=restart_episodes)
    if agents == 1:
        return LoopedCopies([lambda: ResetAhead(gymnasium.make("tests/Traced-v0"))], no_pulse, settings)
    return SeatedCopies([pair], no_pulse, ("agent_0", "agent_1"), settings)


@pytest.mark.parametrize("agents", [1, 2])
def test_attributes_reach_both_instances_and_the_prepared_episode_has_the_old_ones(agents: int) -> None:
    copies = copies_of(agents)
    copies.reset([1], no_pulse)
    for level in (1, 2):
        copies.assign("level", pack(level), no_pulse)
        for _ in range(6):  # two episodes
            copies.step(np.zeros(agents, np.int64), no_pulse)
    copies.close()
    assert [each.level for each in Traced.made] == [2, 2]
    assert [each.levels for each in Traced.made] == [[0, 1, 1, 2], [1, 2]]  # of each reset


@pytest.mark.parametrize("make", [lambda: ResetAhead(gymnasium.make("tests/Traced-v0")), pair], ids=["one agent", "two"])
def test_the_method_of_gymnasium_sets_attributes_on_both_instances_too(make: Callable[[], gymnasium.Env[Any, Any]]) -> None:
    """Vector environments call it, and with them `--inference learner`."""
    env = make()
    env.reset(seed=1)
    assert not env.set_wrapper_attr("absent", 1, force=False)
    assert len(Traced.made) == 1, "a second instance was made for an attribute that neither has"
    env.set_wrapper_attr("absent", 1)
    assert env.get_wrapper_attr("absent") == 1
    values = [1, 2]
    assert env.set_wrapper_attr("levels", values)
    assert env.set_wrapper_attr("level", 3, force=False)
    env.close()
    assert [each.level for each in Traced.made] == [3, 3]
    assert [each.levels for each in Traced.made] == [[1, 2], [1, 2]]
    assert Traced.made[0].levels is not Traced.made[1].levels, "an instance may change its value"


def test_an_attribute_that_a_reset_creates_is_set_in_every_episode() -> None:
    """Before its first reset, the second instance lacks the attribute."""
    env = ResetAhead(gymnasium.make("tests/Windy-v0"))
    env.reset(seed=1)
    for wind in (4, 5):
        env.set_wrapper_attr("wind", wind, force=False)
    seen = []
    for wind in (6, 7, 8, 9):
        env.reset()
        env.instances()  # the other one is reset as well
        before = [each.wind for each in Traced.made if isinstance(each, Windy)]
        env.set_wrapper_attr("wind", wind, force=False)
        seen.append((before, env.unwrapped.wind))  # type: ignore[attr-defined]
    env.close()
    assert [wind for _, wind in seen] == [6, 7, 8, 9]
    assert seen[0][0] == [0, 5], "set before the first reset of the second instance"


def test_an_attribute_that_the_other_instance_lacks_after_its_reset_is_an_error() -> None:
    copies = LoopedCopies([lambda: ResetAhead(gymnasium.make("tests/Windy-v0"))], no_pulse)
    copies.reset([1], no_pulse)
    for _ in range(4):  # the second episode has begun, so the next one is prepared
        copies.step(np.zeros(1, np.int64), no_pulse)
    with pytest.raises(CopyFailed) as caught:
        copies.assign("gust", pack(2.0), no_pulse)
    assert str(caught.value.__cause__).startswith("expected an attribute gust of both instances of ResetAhead")
    copies.close()


def test_only_one_reset_raises_an_error_for_an_attribute_that_the_other_instance_lacks() -> None:
    """The attributes that were set with it reach the other instance."""
    env = ResetAhead(gymnasium.make("tests/Windy-v0"))
    episode(env, 1)
    for name in ("gust", "wind"):
        assert env.set_wrapper_attr(name, 3.0, force=False)
    episode(env)
    with pytest.raises(AttributeError, match="expected an attribute gust of both instances of ResetAhead"):
        env.reset()
    winds = []
    for _ in range(4):
        env.reset()
        env.instances()  # the other one is reset as well
        winds.append([each.wind for each in Traced.made if isinstance(each, Windy)])
    env.close()
    assert winds[0] == [0.0, 3.0], "set before the first reset of the second instance"


def test_a_reset_that_is_tried_again_sets_no_older_value_of_an_attribute() -> None:
    env = ResetAhead(gymnasium.make("tests/Windy-v0"))
    env.reset(seed=1)
    env.set_wrapper_attr("wind", 4.0, force=False)
    Traced.fails = True
    env.reset()
    env.instances()  # the reset in the thread has failed, but has created the attribute
    env.set_wrapper_attr("wind", 5.0, force=False)
    Traced.fails = False
    with pytest.raises(RuntimeError, match="no reset today"):
        env.reset()
    env.reset()
    _, other = env.instances()
    env.close()
    assert other.get_wrapper_attr("wind") == 0.0, "the reset's own value, as in every reset"


@pytest.mark.parametrize("agents", [1, 2])
def test_a_copy_that_resets_ahead_is_never_created_anew(agents: int) -> None:
    copies = copies_of(agents, restart_episodes=1)
    copies.reset([1], no_pulse)
    for _ in range(9):  # three episodes
        copies.step(np.zeros(agents, np.int64), no_pulse)
    assert copies.note == CANNOT_RESTART
    assert copies.begun([]) == {0: None}
    copies.close()
    assert len(Traced.made) == 2


def test_an_attribute_is_not_set_during_a_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    env = ResetAhead(gymnasium.make("tests/Traced-v0"))
    env.reset(seed=1)
    monkeypatch.setattr(Traced, "patience_s", 0.2)  # the reset in the thread takes as long
    Traced.resets_wait_for.clear()
    env.reset()
    copies = LoopedCopies([lambda: env], no_pulse)
    copies.assign("level", pack(1), no_pulse)
    copies.close()
    assert [(each.level, each.set_meanwhile) for each in Traced.made] == [(1, False)] * 2


def test_an_environment_that_gymnasium_did_not_make_is_refused() -> None:
    with pytest.raises(
        UsageError, match=r"ResetAhead: expected an environment of gymnasium.make, got Traced without a spec"
    ):
        ResetAhead(Traced())
