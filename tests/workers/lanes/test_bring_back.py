"""A lane that is brought back goes on as the one that was lost: the rollouts that follow have the same bits."""

from __future__ import annotations

import itertools
import random
import re
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation, NormalizeReward
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from millrace.learner.rollouts.lane_history import LaneHistory
from millrace.learner.rollouts.past_rollouts import packed, unpacked
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.action_masks import without_mask
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.lane_past import LastEpisode
from millrace.protocol.messages import LanePast, Permit
from millrace.protocol.rollout import Rollout
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.protocol.wire.plain_values import pack
from millrace.workers.collect.collector import Collector
from millrace.workers.copies.reset_ahead import ResetAhead
from tests.support.in_process.collectors import (
    SESSION,
    TOY,
    VERSION,
    bits,
    collect,
    loop_over,
    no_pulse,
    random_collector,
    run_around,
    run_of,
)
from tests.support.users_code.mask_envs import CHOICES, InObservation
from tests.support.users_code.seat_envs import AGENTS, RandomCrowd, RandomGame

HERE = "tests.workers.lanes.test_bring_back:"
MOST_STEPS = 10_000
MORE = 3  # rollouts that are compared

Make = Callable[[], gymnasium.Env[Any, Any]]
Attributes = Callable[[int], bytes]
"""By round: those of the env copies, packed."""


def no_attributes(number: int) -> bytes:
    return b""


# ------------------------------------------------------------------------------------------------ environments


class Leveled(gymnasium.Env[Any, Any]):
    """The attribute `level` is in what an episode begins with, in what a step draws, and in its reward."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-100, 100, (2,), np.float32)
        self.action_space = spaces.Discrete(3)
        self.level = 1

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._at = self.level * float(self.np_random.random())
        return self._shown(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._at = (self._at + self.level * float(self.np_random.normal()) + int(action)) % 50
        return self._shown(), self._at / 7, bool(self.np_random.random() < 0.1), False, {}

    def _shown(self) -> Any:
        return np.array([self._at, self.level], np.float32)


class _Seeded:
    """The random histories of `seat_envs`, from the random numbers that PettingZoo's environments have."""

    np_random: np.random.Generator
    _generator: np.random.Generator

    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)  # type: ignore[misc]
        self.np_random = self._generator

    def _observation(self) -> Any:
        return self._generator.random(1, np.float32)


class Game(_Seeded, RandomGame):
    """Agents take turns."""


class Crowd(_Seeded, RandomCrowd):
    """Agents act at the same time."""


class MaskedGame(Game):
    """Agents take turns, and some actions are not allowed."""

    def observation_space(self, agent: str) -> Any:
        return spaces.Dict({"action_mask": spaces.MultiBinary(3), "seen": spaces.Box(0, np.inf, (1,), np.float32)})

    def last(self, observe: bool = True) -> Any:
        seen, *others = super().last(observe)
        bits = int(1 + 7 * float(self._shown[self.agent_selection][0])) if observe else 7
        return {"seen": seen, "action_mask": np.array([bits & 1, bits & 2, bits & 4], bool).astype(np.int8)}, *others


gymnasium.register("Leveled-v0", f"{HERE}Leveled")


def seated_run(kind: type[RandomGame | RandomCrowd], T: int, N: int, **policy: Any) -> RunSpec:
    env = kind()
    space = env.observation_space("a")
    masked = isinstance(space, spaces.Dict)
    seen = without_mask(space, env.action_space("a")) if masked else space
    spec = PolicySpec(observation_leaves(seen), action_spec(env.action_space("a")), **policy)
    turns = kind is not Crowd
    name = EnvSpec(f"{HERE}{kind.__name__}")
    return RunSpec(name, spec, T, N, lanes=8, seed=1, seats=AGENTS, takes_turns=turns, masked=masked)


def masked_run(T: int, N: int) -> RunSpec:
    env = InObservation()
    policy = PolicySpec(
        observation_leaves(without_mask(env.observation_space, env.action_space)), action_spec(env.action_space)
    )
    name = EnvSpec.of("tests.support.users_code.mask_envs:InObservation-v0", {})
    assert env.action_space.n == CHOICES
    return RunSpec(name, policy, T, N, lanes=8, seed=1, masked=True)


def tuple_run(T: int, N: int) -> RunSpec:
    name = EnvSpec.of("tests.support.users_code.tuple_envs:Lamps-v0", wrappers=["millrace:TupleOfAgents"])
    env = name.make()
    policy = PolicySpec(observation_leaves(env.observation_space), action_spec(env.action_space))
    seats = ("agent_0", "agent_1")
    return RunSpec(name, policy, T, N, lanes=8, seed=1, seats=seats)


RUNS: dict[str, Callable[[int, int], RunSpec]] = {
    "discrete": lambda T, N: run_of("CartPole-v1", T, N),
    "gaussian": lambda T, N: run_of("Pendulum-v1", T, N),
    "squashed": lambda T, N: run_of("Pendulum-v1", T, N, head="squashed"),
    "lstm": lambda T, N: run_of("CartPole-v1", T, N, core="lstm", core_size=5),
    "gru": lambda T, N: run_of(f"{TOY}Recall-v0", T, N, core="gru", core_size=3),
    "dict": lambda T, N: run_of(f"{TOY}Spaces-v0", T, N, {"observation": "dict", "action": "table"}),
    "mixed": lambda T, N: run_of(f"{TOY}Spaces-v0", T, N, {"action": "mixed"}),
    "masks": masked_run,
    "turns": lambda T, N: seated_run(Game, T, N),
    "turns, lstm": lambda T, N: seated_run(Game, T, N, core="lstm", core_size=3),
    "turns, masks": lambda T, N: seated_run(MaskedGame, T, N),
    "together": lambda T, N: seated_run(Crowd, T, N),
    "together, a tuple": tuple_run,
    "together, gru": lambda T, N: seated_run(Crowd, T, N, core="gru", core_size=3),
}


# ------------------------------------------------------------------------------------------------ two lives of a lane


def rollout_of(collector: Collector, run: RunSpec, number: int, attributes: Attributes, past: LanePast | None) -> Rollout:
    """The rollout of lane 0 in this round, on env copies that continue `past` if they are not here."""
    collector.env_attributes = attributes(number)
    if past is None:
        return collect(collector, run, number)[0]
    return collector.collect([Permit(100, 0, 1, number, number, past=past)], VERSION, SESSION, no_pulse)[0]


def past_of(
    run: RunSpec, rollouts: Sequence[Rollout], attributes: Attributes = no_attributes, *, resumes: bool = False
) -> LanePast:
    """What is handed to a worker after these rollouts. `resumes`: the learner is resumed after each of them."""
    history = LaneHistory.of_nothing(run.copies, MOST_STEPS)
    for number, rollout in enumerate(rollouts):
        history.add(rollout, attributes(number))
        if resumes:
            history = LaneHistory.of(saved(history.past(0)), MOST_STEPS)
    return saved(history.past(0))


def saved(past: LanePast) -> LanePast:
    """As a checkpoint keeps it."""
    return unpacked(LanePast, packed(past))


def all_bits(rollout: Rollout) -> dict[str, object]:
    """What must be the same in a rollout, and what the next worker is told of its past. Seconds are not."""
    seconds_off = [rollout.memory[0][:, :-1].tobytes()] if rollout.memory else []
    return {
        **bits(rollout),
        "mask": None if rollout.mask is None else rollout.mask.tobytes(),
        "resets": None if rollout.resets is None else rollout.resets.tobytes(),
        "facts": [(episode.facts, episode.opponent) for episode in rollout.episodes],
        "begun": rollout.begun,
        "memory": [*seconds_off, *(each.tobytes() for each in rollout.memory[1:])],
    }


def assert_goes_on(
    run: RunSpec, borders: list[int], attributes: Attributes = no_attributes, *, resumes: bool = False
) -> None:
    """The lane is lost after so many rollouts, again and again, and it makes no difference. Nor does it that copies are made
    anew in between, if the run asks for it.
    """
    rounds = borders[-1] + MORE
    undisturbed = random_collector(replace(run, restart_episodes=0))
    expected = [rollout_of(undisturbed, run, number, attributes, None) for number in range(rounds)]
    collector = random_collector(run)
    found: list[Rollout] = []
    past: LanePast | None = None
    for number in range(rounds):
        if number in borders and number:
            collector.lanes.close_all()
            collector = random_collector(run)
            past = past_of(run, found, attributes, resumes=resumes)
        found.append(rollout_of(collector, run, number, attributes, past))
        assert "deterministic" not in collector.note, f"round {number}: {collector.note}"
        assert all_bits(found[-1]) == all_bits(expected[number]), f"round {number}"
    undisturbed.lanes.close_all()
    collector.lanes.close_all()


BORDERS = st.lists(st.integers(1, 5), min_size=1, max_size=2, unique=True)


@pytest.mark.parametrize("kind", RUNS)
@given(
    T=st.integers(1, 14), N=st.integers(1, 3), borders=BORDERS, resumes=st.booleans(), restarts=st.sampled_from([0, 1, 3])
)
@example(T=1, N=2, borders=[1], resumes=False, restarts=0)
@example(T=9, N=2, borders=[2, 3, 5], resumes=True, restarts=1)
@settings(max_examples=8, deadline=None)
def test_a_lane_that_is_brought_back_goes_on_as_it_would_have(
    kind: str, T: int, N: int, borders: list[int], resumes: bool, restarts: int
) -> None:
    run = replace(RUNS[kind](T, N), restart_episodes=restarts)
    assert_goes_on(run, sorted(borders), resumes=resumes)


@pytest.mark.parametrize(
    ("T", "borders"),
    [(10, [1]), (11, [1]), (1, [9]), (1, [10]), (1, [11]), (1, [12]), (1, [10, 11, 12])],
    ids=["over", "reset last", "last step", "over alone", "reset alone", "first step", "each"],
)
def test_an_episode_may_end_wherever_rollouts_are_cut(T: int, borders: list[int]) -> None:
    assert_goes_on(run_of(f"{TOY}Identity-v0", T, N=2), borders)  # all its episodes have 10 steps


# ------------------------------------------------------------------------------------------------ attributes


@given(
    T=st.integers(1, 9),
    N=st.integers(1, 3),
    borders=BORDERS,
    levels=st.lists(st.sampled_from([None, 1, 2, 5]), min_size=8, max_size=8),
    resumes=st.booleans(),
    restarts=st.sampled_from([0, 1]),
)
# The first ones come during an episode.
@example(T=3, N=2, borders=[2], levels=[None, 5, 5, 5, 2, 2, 2, 2], resumes=True, restarts=0)
@example(T=3, N=2, borders=[3], levels=[5, 5, 2, 2, 2, 2, 2, 2], resumes=False, restarts=1)
@settings(max_examples=40, deadline=None)
def test_each_row_is_repeated_with_the_attributes_that_it_had(
    T: int, N: int, borders: list[int], levels: list[int | None], resumes: bool, restarts: int
) -> None:
    last: list[int | None] = []  # a run sets an attribute again and again, and never takes one back
    for level in levels:
        last.append(level if level is not None or not last else last[-1])

    def attributes(number: int) -> bytes:
        level = last[min(number, len(last) - 1)]
        return b"" if level is None else pack({"level": level})

    run = replace(run_of(f"{HERE}Leveled-v0", T, N), restart_episodes=restarts)
    assert_goes_on(run, sorted(borders), attributes, resumes=resumes)


# ------------------------------------------------------------------------------------------------ no repetition


class Walk(gymnasium.Env[Any, Any]):
    """A random walk that `Lives` counts. Where it draws from, and how it differs the second time, is up to the class."""

    length = 7

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-100, 100, (1,), np.float32)
        self.action_space = spaces.Discrete(2)
        self.prepare()

    def prepare(self) -> None:
        """Before the first reset."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        self._at = self.draw()
        return self._shown(), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._steps += 1
        self._at += self.draw() + int(action)
        return self._shown(), self.reward(), self._steps == self.length, False, {}

    def draw(self) -> float:
        return float(self.np_random.random())

    def reward(self) -> Any:
        return self._at

    def _shown(self) -> Any:
        return np.array([self._at], np.float32)


class Clocked(Walk):
    """It draws from a counter of its process, as from a clock."""

    def draw(self) -> float:
        return next(CLOCK) / 1000


CLOCK = itertools.count()


class ClockedReward(Walk):
    """Only its rewards differ."""

    def reward(self) -> Any:
        return next(CLOCK) / 1000


class Shorter(Walk):
    """Each one that is made has shorter episodes."""

    def prepare(self) -> None:
        self.length = 20 - 4 * next(MADE)


MADE = itertools.count()


class OwnRandom(Walk):
    """It has a generator of Python's, which it seeds as it should."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._own = random.Random(seed)
        self._steps = 0
        self._at = self.draw()
        return self._shown(), {}

    def draw(self) -> float:
        return self._own.random()


class Unseeded(Walk):
    """It makes its generator itself, and never seeds it."""

    def prepare(self) -> None:
        self.np_random = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return super().reset()


class Odd(Walk):
    """A walk that gives another reward, shows something else or calls a function in its third step, until it starts anew."""

    def __init__(self, reward: Any = ..., shown: float = 0, does: Callable[[], Any] = int) -> None:
        super().__init__()
        self._odd = reward, shown, does
        self._starts = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self._starts += seed is not None
        return super().reset(seed=seed)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, *others = super().step(action)
        if self._starts == 1 and self._steps == 3:
            odd_reward, shown, does = self._odd
            does()
            return observation + np.float32(shown), reward if odd_reward is ... else odd_reward, *others
        return observation, reward, *others


def continued(make: Make, T: int, rounds: int, then: Make | None = None) -> tuple[Collector, LanePast, Rollout, RunSpec]:
    """A lane with two copies that is lost after so many rollouts: who has it then, and the next rollout.

    `then`: makes the copies of who has it then.
    """
    run = replace(run_around(make(), T), copies=2)
    first = random_collector(run, loop_over([make] * 2))
    rollouts = [rollout_of(first, run, number, no_attributes, None) for number in range(rounds)]
    past = past_of(run, rollouts)
    second = random_collector(run, loop_over([then or make] * 2))
    rollout = rollout_of(second, run, rounds, no_attributes, past)
    validate(rollout, run)
    return second, past, rollout, run


def started_anew(rollout: Rollout) -> dict[int, int]:
    """By copy, the number of the start of the new episodes of a rollout."""
    return {each.copy: each.start for each in rollout.begun if each.start}


@pytest.mark.parametrize(
    ("make", "T", "rounds", "why"),
    [
        (Clocked, 3, 1, "it shows another observation"),
        (Clocked, 3, 4, "it shows another observation"),
        (ClockedReward, 3, 4, "its rewards add up to another return"),
        (Shorter, 5, 2, "it ended earlier"),
        (Unseeded, 3, 1, "it shows another observation"),
        (lambda: NormalizeReward(Walk()), 3, 4, "its rewards add up to another return"),
        (lambda: NormalizeObservation(Walk()), 3, 4, "it shows another observation"),
        (lambda: NormalizeObservation(OwnRandom()), 3, 4, ""),
        (OwnRandom, 3, 4, ""),
        (lambda: ResetAhead(gymnasium.make("Pendulum-v1", max_episode_steps=7)), 3, 4, ""),
    ],
)
def test_a_copy_that_does_not_repeat_itself_starts_anew(
    make: Make, T: int, rounds: int, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("CLOCK", "MADE"):
        monkeypatch.setitem(globals(), name, itertools.count())
    collector, past, rollout, run = continued(make, T, rounds)
    assert past.new_episodes == (0 if why else 2)  # the learner says how many cannot be repeated
    assert why in collector.note
    assert bool(why) == ("deterministic" in collector.note)
    assert collector.lanes[0].starts == [1, 1]
    assert started_anew(rollout) == {0: 1, 1: 1}
    for number in range(rounds + 1, rounds + 4):
        validate(rollout_of(collector, run, number, no_attributes, past), run)


@pytest.mark.parametrize(
    ("odd", "why"),
    [
        ({"reward": np.nan}, "its rewards add up to another return"),
        ({"reward": np.inf}, "its rewards add up to another return"),
        ({"reward": -np.inf}, "its rewards add up to another return"),
        ({"reward": None}, "its rewards add up to another return"),
        ({"shown": np.nan}, "it shows another observation"),
        ({"shown": 1e-3}, "it shows another observation"),
    ],
)
def test_a_copy_that_gives_other_numbers_while_it_is_repeated_starts_anew(odd: Any, why: str) -> None:
    collector, _, rollout, _ = continued(Walk, T=3, rounds=1, then=lambda: Odd(**odd))
    assert why in collector.note
    assert started_anew(rollout) == {0: 1, 1: 1}


def fails() -> None:
    raise SystemExit(3)  # worse than any other exception


@pytest.mark.parametrize(
    ("odd", "why"),
    [
        ({"does": fails}, "SystemExit"),
        ({"reward": "one"}, "reward: expected a number, got 'one'"),
        ({"reward": np.ones(2)}, "reward: expected a number, got an array of shape (2,)"),
    ],
)
def test_what_a_copy_does_wrong_while_it_is_repeated_is_a_failure_of_its_lane(odd: Any, why: str) -> None:
    with pytest.raises(EnvironmentFailed, match=re.escape(why)) as failed:
        continued(Walk, T=3, rounds=2, then=lambda: Odd(**odd))
    assert failed.value.lane == 0
    assert "while its episode was continued" in str(failed.value)


class ArrayRewards(Walk):
    """Its rewards are arrays of one element."""

    def reward(self) -> Any:
        return np.array([self._at])


def test_rewards_may_be_arrays_of_one_element(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = itertools.cycle([4, 7])
    monkeypatch.setattr(ArrayRewards, "prepare", lambda self: setattr(self, "length", next(lengths)))
    run = replace(run_around(ArrayRewards(), 1), copies=2)
    next(lengths)
    opens = loop_over([ArrayRewards] * 2)
    first = random_collector(run, opens)
    rollouts = [rollout_of(first, run, number, no_attributes, None) for number in range(6)]
    second = random_collector(run, opens)  # it resets one copy while the other one is in the middle of an episode
    rollouts.append(rollout_of(second, run, 6, no_attributes, past_of(run, rollouts)))
    assert second.note == ""
    assert all_bits(rollouts[-1]) == all_bits(rollout_of(first, run, 6, no_attributes, None))


# ------------------------------------------------------------------------------------------------ pasts of nobody


def with_column(rows: Any, column: int, value: float) -> Any:
    found = rows.copy()
    found[:, column] = value
    return found


ONE_MORE = LastEpisode(4, b"", 0, False)
WRONG: dict[str, Callable[[LanePast], dict[str, Any]]] = {
    "no copies": lambda past: {"copies": ()},
    "a copy more": lambda past: {"copies": (*past.copies, ONE_MORE)},
    "a copy less": lambda past: {"copies": past.copies[:1]},
    "begins later": lambda past: {"copies": tuple(replace(last, first=10**6) for last in past.copies)},
    "random bytes": lambda past: {"copies": tuple(replace(last, random=b"123", first=1) for last in past.copies)},
    "more random bytes": lambda past: {"copies": tuple(replace(last, random=bytes(64), first=1) for last in past.copies)},
    "other random bytes": lambda past: {"copies": tuple(replace(last, random=bytes(37), first=1) for last in past.copies)},
    "no row before": lambda past: {"copies": tuple(replace(last, random=bytes(37)) for last in past.copies)},
    "over from nothing": lambda past: {"copies": tuple(replace(last, random=b"", over=True) for last in past.copies)},
    "no rows": lambda past: {"action": past.action[:0]},
    "a number": lambda past: {"action": np.array(0)},
    "another action": lambda past: {"action": np.zeros((*past.action.shape, 2), np.float32)},
    "narrow actions": lambda past: {"action": past.action.astype(np.int32)},
    "fewer columns": lambda past: {"action": past.action[:, :1]},
    "no observation": lambda past: {"obs": ()},
    "an observation more": lambda past: {"obs": (*past.obs, past.obs[0])},
    "double observation": lambda past: {"obs": (past.obs[0].astype(np.float64), *past.obs[1:])},
    "a scalar observation": lambda past: {"obs": (np.zeros((), np.float32), *past.obs[1:])},
    "NaN observation": lambda past: {"obs": (np.full_like(past.obs[0], np.nan), *past.obs[1:])},
    "no memory": lambda past: {"memory": ()},
    "less memory": lambda past: {"memory": past.memory[:-1]},
    "more memory": lambda past: {"memory": (*past.memory, np.zeros(3))},
    "scalars": lambda past: {"memory": tuple(np.zeros((), each.dtype) for each in past.memory)},
    "another order": lambda past: {"memory": past.memory[::-1]},
    "NaN return": lambda past: {"memory": (with_column(past.memory[0], 0, np.nan), *past.memory[1:])},
    "NaN seconds": lambda past: {"memory": (with_column(past.memory[0], -1, np.nan), *past.memory[1:])},
    "seconds to come": lambda past: {"memory": (with_column(past.memory[0], -1, -1.0), *past.memory[1:])},
}


@pytest.mark.parametrize("kind", ["lstm", "turns, lstm"])
@pytest.mark.parametrize("wrong", WRONG)
def test_a_past_of_another_lane_is_not_continued(wrong: str, kind: str) -> None:
    run = RUNS[kind](4, 2)
    first = random_collector(run)
    rollouts = [rollout_of(first, run, number, no_attributes, None) for number in range(2)]
    past = past_of(run, rollouts)
    assert past.new_episodes == 0
    newest = max((last.start for last in past.copies), default=0)
    past = replace(past, **WRONG[wrong](past))
    collector = random_collector(run)
    for number in (2, 3):
        validate(rollout_of(collector, run, number, no_attributes, past), run)
    assert min(collector.lanes[0].starts) > newest
    assert len(collector.lanes[0].starts) == run.copies
