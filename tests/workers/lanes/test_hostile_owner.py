"""What a hostile worker sends of its lane never harms the worker that gets the lane next.

The learner accepts that worker's rollouts, and neither its policy nor its environment seems to fail.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from msgspec.structs import replace

from millrace.learner.rollouts.lane_history import LaneHistory
from millrace.protocol.bounds import LARGEST
from millrace.protocol.lane_past import EpisodeBegin
from millrace.protocol.messages import LanePast, Permit, Rollout
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.specs import OwnPolicySpec, RunSpec
from millrace.protocol.wire.codec import decode_to_learner, encode
from millrace.workers.collect.collector import Collector, OpenEnvCopies
from millrace.workers.copies.saved_state import SavedCopy, packed, unpacked
from millrace.workers.lanes.bring_back import IMPOSSIBLE
from tests.support.in_process.collectors import (
    SESSION,
    TOY,
    VERSION,
    bits,
    loop_over,
    no_pulse,
    random_collector,
    run_around,
    run_of,
)
from tests.workers.lanes.test_bring_back import MaskedGame, seated_run

T = 4
HERS, MORE = 5, 20  # how many rollouts the hostile worker collects, and then the honest one


class Saves(gymnasium.Env[Any, Any]):
    """A walk that saves its place. Only the wrapper `TimeLimit` ends its episodes."""

    observation_space = spaces.Box(-np.inf, np.inf, (8,))
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place = 0.0
        return np.zeros(8, np.float32), {}

    def step(self, action: Any) -> Any:
        self.place += float(self.np_random.normal())
        return np.full(8, self.place, np.float32), 1.0, False, False, {}

    def save_state(self) -> bytes:
        return struct.pack("d", self.place)

    def load_state(self, state: bytes) -> None:
        (self.place,) = struct.unpack("d", state)


def saving() -> Any:
    return TimeLimit(Saves(), 30)


def with_policy(run: RunSpec, **changed: Any) -> RunSpec:
    return replace(run, policy=replace(run.policy, **changed))


RUNS: dict[str, Callable[[], RunSpec]] = {
    "plain": lambda: run_of("CartPole-v1", T, 2),
    "over": lambda: run_of(f"{TOY}Identity-v0", 10 // HERS, 2),  # all its episodes have 10 steps
    "lstm": lambda: run_of("CartPole-v1", T, 2, core="lstm", core_size=5),
    "gru": lambda: run_of("CartPole-v1", T, 2, core="gru", core_size=5),
    "seats": lambda: seated_run(MaskedGame, T, 2, core="gru", core_size=3),
    "saves": lambda: replace(run_around(saving(), T), copies=2),
    "saves, relu": lambda: with_policy(RUNS["saves"](), activation="relu"),
    "saves, own": lambda: with_own_policy(RUNS["saves"]()),
    "saves, gru": lambda: with_policy(RUNS["saves"](), activation="relu", core="gru", core_size=5),
}


class Cautious:
    """A policy of the user's own, which raises if observations are large."""

    def act(self, obs: Any, state: Any, rng: np.random.Generator) -> Any:
        assert np.abs(obs).max() < 1e30
        return rng.integers(2, size=len(obs)), state, {}


def with_own_policy(run: RunSpec) -> RunSpec:
    return with_policy(run, own=OwnPolicySpec(f"{__name__}:Cautious", ()))


Lie = Callable[[Rollout], dict[str, Any]]


def filled(index: int, value: Any, column: Any = ...) -> Lie:
    """An array of the memory with this value in all its entries, or in those of one column."""

    def lie(rollout: Rollout) -> dict[str, Any]:
        memory = [array.copy() for array in rollout.memory]
        memory[index][:, column] = value
        return {"memory": tuple(memory)}

    return lie


def states(change: Callable[[SavedCopy], SavedCopy]) -> Lie:
    def lie(rollout: Rollout) -> dict[str, Any]:
        changed = packed([change(state) for state in unpacked(rollout.memory[-1])])
        return {"memory": (*rollout.memory[:-1], np.frombuffer(changed, np.uint8))}

    return lie


def nested(rollout: Rollout) -> dict[str, Any]:
    """More levels of lists than can be decoded, after the three fields of a state."""
    deep = b"\x91\x94\xc4\x00\xc0\x90" + b"\x91" * 100_000 + b"\x90"
    return {"memory": (*rollout.memory[:-1], np.frombuffer(deep, np.uint8))}


def large_observation(rollout: Rollout) -> dict[str, Any]:
    """In the last row, finite numbers from which a policy computes infinite ones."""
    obs = rollout.obs[0].copy()
    obs[-1] = np.resize([3e38, -3e38], 8)
    return {"obs": (obs,)}


def forbidden(rollout: Rollout) -> dict[str, Any]:
    """In the last row, seats without an outcome repeat an action that their mask forbids."""
    assert rollout.mask is not None
    action, held, mask = rollout.action.copy(), rollout.memory[4].copy(), rollout.mask[-1]
    wrong = ~rollout.valid[-1] & ~mask.all(-1)
    held[wrong] = action[-1][wrong] = mask[wrong].argmin(-1)
    return {"action": action, "memory": (*rollout.memory[:4], held, *rollout.memory[5:])}


def all_saved(rollout: Rollout) -> dict[str, Any]:
    blob = packed([SavedCopy(b"", None, ())] * 2)
    return {"memory": (*rollout.memory, np.frombuffer(blob, np.uint8)), "saved": (0, 1)}


NO_LINE = ""  # nothing is wrong that matters, or nothing can be known
CASES: dict[str, tuple[str, Lie, str]] = {
    **{f"the truth: {kind}": (kind, lambda rollout: {}, NO_LINE) for kind in RUNS},
    "lengths": ("plain", lambda rollout: {"memory": (np.full((2, 2), 1e15), *rollout.memory[1:])}, IMPOSSIBLE),
    "returns": ("plain", filled(0, 1e300, 0), IMPOSSIBLE),
    "a NaN return": ("plain", filled(0, np.nan, 0), IMPOSSIBLE),
    "returns of episodes that are over": ("over", filled(0, 3e38, 0), NO_LINE),
    "seconds": ("plain", filled(0, 0.99e9, 1), IMPOSSIBLE),
    "infinite seconds": ("plain", filled(0, np.inf, 1), IMPOSSIBLE),
    "a negative time": ("plain", filled(0, -1.0, 1), IMPOSSIBLE),
    "a NaN state": ("lstm", filled(1, np.nan), IMPOSSIBLE),
    "a NaN in cells": ("lstm", filled(1, np.nan, slice(5, None)), IMPOSSIBLE),
    "a large output": ("lstm", filled(1, 3e38, slice(5)), IMPOSSIBLE),
    "a large state": ("gru", filled(1, -3e38), IMPOSSIBLE),
    "a state that waits": ("seats", filled(2, np.nan), IMPOSSIBLE),
    "params of seats that wait": ("seats", filled(3, np.nan), IMPOSSIBLE),
    "params that allow nothing": ("seats", filled(3, [3e38, -3e38, -3e38]), IMPOSSIBLE),
    "actions of seats that wait": ("seats", filled(4, 3), IMPOSSIBLE),
    "other actions of seats that wait": ("seats", lambda rollout: filled(4, 2 - rollout.memory[4])(rollout), IMPOSSIBLE),
    "nothing of seats that wait": ("seats", lambda rollout: {"memory": rollout.memory[:3]}, IMPOSSIBLE),
    "forbidden actions of seats that wait": ("seats", forbidden, "an agent waits after an action that its mask forbids"),
    "the largest start": ("plain", lambda rollout: {"begun": last_starts(rollout)}, NO_LINE),
    "random bytes": ("plain", lambda rollout: {"begun": (EpisodeBegin(0, 0, bytes([255] * 37)),)}, "began instead"),
    "no state": ("plain", all_saved, "load_state raised AssertionError"),
    "no state of seats": ("seats", all_saved, "load_state raised AssertionError"),
    "nested states": ("saves", nested, "its state is damaged"),
    "returns with states": ("saves", filled(0, 1e300, 0), IMPOSSIBLE),
    "a time limit that never comes": ("saves", states(lambda each: replace(each, elapsed=(-(10**18),))), "is damaged"),
    "more time limits": (
        "saves",
        states(lambda each: replace(each, elapsed=each.elapsed * 2)),
        "load_state raised ValueError",
    ),
    "an observation from which the policy can act": ("saves", large_observation, NO_LINE),
    "a large observation": ("saves, relu", large_observation, IMPOSSIBLE),
    "a large observation of a user's policy": ("saves, own", large_observation, IMPOSSIBLE),
    "a large observation with a core": ("saves, gru", large_observation, NO_LINE),
    "a generator": ("saves", states(lambda each: replace(each, random=bytes(5))), NO_LINE),
}


def last_starts(rollout: Rollout) -> tuple[EpisodeBegin, ...]:
    return tuple(EpisodeBegin(n, LARGEST // 2 + rollout.ticket, None) for n in range(2))


def own_collector(run: RunSpec, open_copies: OpenEnvCopies) -> Collector:
    return Collector(run, CalledPolicy(run.policy, ()), open_copies)


def collected(collector: Collector, run: RunSpec, number: int, past: LanePast | None = None) -> Rollout:
    """The rollout of this round, as the learner reads it. If there is a `past`, the collector continues it at first."""
    permit = Permit(100 + number, 0, int(past is not None), number, number, past=past)
    (rollout,) = collector.collect([permit], VERSION, SESSION, no_pulse)
    message = decode_to_learner([bytes(frame) for frame in encode(rollout)])
    assert isinstance(message, Rollout)
    return message


def accepted(rollout: Rollout, run: RunSpec, number: int) -> None:
    validate(rollout, run, (number + 1) * run.rollout_steps)


@pytest.mark.parametrize("case", CASES)
def test_the_next_owner_is_not_harmed(case: str) -> None:
    kind, lie, line = CASES[case]
    run = RUNS[kind]()
    collector_of = own_collector if run.policy.own else random_collector
    made = (loop_over([saving] * 2),) if kind.startswith("saves") else ()
    hostile, honest = (collector_of(run, *made) for _ in range(2))
    history = LaneHistory.of_nothing(run.copies, 10_000)
    for number in range(HERS):
        rollout = collected(hostile, run, number)
        rollout = replace(rollout, **lie(rollout))
        accepted(rollout, run, number)
        history.add(rollout, b"")
    ended = 0
    for number in range(HERS, HERS + MORE):
        rollout = collected(honest, run, number, history.past(0))
        accepted(rollout, run, number)
        assert all(episode.reward < 1_000 and episode.seconds < 1_000 for episode in rollout.episodes)
        if kind.startswith("saves"):
            assert {episode.length for episode in rollout.episodes} <= {30}
        ended += len(rollout.episodes)
        if number == HERS:
            assert (line in honest.note) if line else not honest.note
    assert ended


@pytest.mark.parametrize("kind", [kind for kind in RUNS if kind.startswith("saves")])
def test_a_lane_from_saved_states_continues_with_the_same_bits_as_if_it_had_not_moved(kind: str) -> None:
    run = RUNS[kind]()
    collector_of = own_collector if run.policy.own else random_collector
    stays, leaves, comes = (collector_of(run, loop_over([saving] * 2)) for _ in range(3))
    history = LaneHistory.of_nothing(run.copies, 10_000)
    for number in range(HERS):
        collected(stays, run, number)
        history.add(collected(leaves, run, number), b"")
    for number in range(HERS, HERS + MORE):
        assert bits(collected(comes, run, number, history.past(0))) == bits(collected(stays, run, number))


def test_what_seats_that_do_not_act_repeat_is_checked_even_if_every_episode_is_over() -> None:
    run = seated_run(MaskedGame, 1, 1)
    hostile, honest = random_collector(run), random_collector(run)
    history = LaneHistory.of_nothing(1, 10_000)
    lie = filled(3, run.policy.action.sizes[0])  # an action that doesn't exist
    for number in range(200):
        rollout = collected(hostile, run, number)
        history.add(replace(rollout, **lie(rollout)), b"")
        if not len(history.past(0).action):
            break
    assert history.past(0).copies[0].over
    accepted(collected(honest, run, number + 1, history.past(0)), run, number + 1)
    assert honest.note == IMPOSSIBLE
