"""Every way to make an env copy says which one it is, and holds a slot of its own until the copy is closed."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from msgspec.structs import replace

import millrace
from millrace import EnvCopy
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UsageError
from millrace.protocol.messages import Describe, Reset
from millrace.protocol.specs import RunSpec
from millrace.protocol.wire.plain_values import pack
from millrace.workers import copy_slots
from millrace.workers.collect.collector import open_env_copies
from millrace.workers.copies.reset_ahead import ResetAhead
from millrace.workers.copy_slots import close_described
from millrace.workers.described_copy import describe
from millrace.workers.evaluate.evaluator import open_looped_copies
from millrace.workers.vector_env.stepper import Stepper
from tests.support.conversation.example_messages import example
from tests.support.envs.toy import Countdown
from tests.support.in_process.collectors import no_pulse, run_of
from tests.support.in_process.described import step_spec

MODULE = __name__


class Slots:
    """The slots of a machine on which only this test runs."""

    def __init__(self) -> None:
        self.taken = set[int]()

    def take(self) -> int:
        slot = min(set(range(len(self.taken) + 1)) - self.taken)
        self.taken.add(slot)
        return slot

    def give_back(self, slot: int) -> None:
        self.taken.remove(slot)


class Asks(Countdown):
    """Its constructor asks which copy it is."""

    made: ClassVar[list[EnvCopy]] = []
    taken: ClassVar[set[int]] = set()
    closed_late: ClassVar[list[int]] = []
    fails_at: ClassVar[int] = -1

    def __init__(self, k: int = 3) -> None:
        super().__init__(k)
        self.copy = millrace.env_copy()
        self.made.append(self.copy)
        if self.copy.number == Asks.fails_at:
            raise OSError("no licence")

    def close(self) -> None:
        self.closed_late.extend({self.copy.slot} - self.taken)


def asking_together(num_envs: int) -> SyncVectorEnv:
    """The vectorized form of `Asks`."""
    Asks.made.append(millrace.env_copy())
    return SyncVectorEnv([lambda: Countdown(3)] * num_envs, autoreset_mode=AutoresetMode.NEXT_STEP)


gymnasium.register("Asks-v0", entry_point=f"{MODULE}:Asks", vector_entry_point=f"{MODULE}:asking_together")


@pytest.fixture(autouse=True)
def taken(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[int]]:
    """The slots that are taken."""
    machine = Slots()
    monkeypatch.setattr(copy_slots, "slots", lambda: machine)
    monkeypatch.setattr(Asks, "made", [])
    monkeypatch.setattr(Asks, "taken", machine.taken)
    monkeypatch.setattr(Asks, "closed_late", [])
    monkeypatch.setattr(copy_slots, "_slots", {})
    copy_slots._of_process.cache_clear()
    yield machine.taken
    assert not Asks.closed_late, "slots that were given back before their copy was closed"
    copy_slots._of_process.cache_clear()


def run_with(vector: str = "loop") -> RunSpec:
    """A run with two copies in a lane."""
    found = run_of("tests.support.envs.toy:Countdown-v0", N=2, kwargs={"k": 3})
    return RunSpec(EnvSpec("Asks-v0"), found.policy, rollout_steps=8, copies=2, lanes=8, seed=1, vector=vector)


def test_copies_of_a_lane_follow_those_of_the_lanes_before_it(taken: set[int]) -> None:
    lanes = [open_env_copies(run_with(), lane, no_pulse) for lane in (3, 0)]
    assert Asks.made == [EnvCopy(6, 3, 0, False, 0), EnvCopy(7, 3, 1, False, 1), EnvCopy(0, 0, 0, False, 2),
                         EnvCopy(1, 0, 1, False, 3)]  # fmt: skip
    lanes[0].close()
    assert taken == {2, 3}
    again = open_env_copies(run_with(), 3, no_pulse)
    assert Asks.made[-2:] == [EnvCopy(6, 3, 0, False, 0), EnvCopy(7, 3, 1, False, 1)]
    again.close()
    lanes[1].close()
    assert not taken


def test_one_call_that_makes_all_copies_of_a_lane_asks_for_the_first(taken: set[int]) -> None:
    copies = open_env_copies(run_with("native"), 3, no_pulse)
    assert Asks.made == [EnvCopy(6, 3, 0, False, 0)]
    assert taken == {0}
    copies.close()
    assert not taken


def test_copies_of_envpool_hold_a_slot(taken: set[int]) -> None:
    pytest.importorskip("envpool")
    run = run_of("CartPole-v1", N=2)
    run = RunSpec(run.env, run.policy, rollout_steps=8, copies=2, lanes=8, seed=1, vector="envpool")
    copies = open_env_copies(run, 1, no_pulse)
    copies.reset([1, 2], no_pulse)
    assert taken == {0}
    copies.close()
    assert not taken


@pytest.mark.parametrize(
    ("settings", "made"),
    [
        ({}, [(0, 0, 0, False), (1, 0, 1, False), (2, 0, 2, False), (3, 1, 0, False), (4, 1, 1, False)]),
        ({"single_lanes": 2}, [(0, 0, 0, False), (1, 0, 1, False), (2, 0, 2, False), (3, 1, 0, False), (4, 1, 1, False),
                               (0, 0, 0, True), (1, 0, 1, True)]),
        ({"evaluates": True}, [(0, 0, 0, True), (1, 0, 1, True), (2, 0, 2, True), (3, 0, 3, True), (4, 0, 4, True)]),
    ],
)  # fmt: skip
def test_copies_of_a_vector_environment(settings: dict[str, Any], made: list[Any], taken: set[int]) -> None:
    spec = step_spec(VectorEnvSettings("Asks-v0", 5, lanes=2, workers=2, **settings))
    Asks.made.clear()
    stepper = Stepper(spec)
    for lane, copies in enumerate(spec.lanes):
        options = np.frombuffer(pack(None), np.uint8)
        stepper.execute(
            example(
                Reset, session=1, ticket=1, lane=lane, copies=tuple(range(copies)), seeds=(1,) * copies, options=options
            ),
            no_pulse,
        )
    assert [(copy.number, copy.lane, copy.copy, copy.evaluation) for copy in Asks.made] == made
    assert [copy.slot for copy in Asks.made] == list(range(len(made)))
    stepper.lanes.close_all()
    assert not taken


def test_copies_that_play_evaluations_are_numbered_among_themselves(taken: set[int]) -> None:
    copies = open_looped_copies(run_with(), 3, None, no_pulse)
    assert Asks.made == [EnvCopy(n, 0, n, True, n) for n in range(3)]
    copies.close()
    assert not taken


@pytest.mark.parametrize("vector", ["loop", "native"])
def test_the_copy_that_is_described_is_number_0(vector: str, taken: set[int]) -> None:
    describe(Describe(1, 1, EnvSpec("Asks-v0"), vector))
    assert Asks.made == [EnvCopy(slot=0), EnvCopy(slot=1)][: 1 if vector == "loop" else 2]
    assert taken == {0}
    close_described()
    assert not taken


def test_the_copy_that_was_described_is_the_first_of_the_run(taken: set[int]) -> None:
    describe(Describe(1, 1, EnvSpec("Asks-v0")))
    copies = open_env_copies(run_with(), 0, no_pulse)
    assert Asks.made == [EnvCopy(0, 0, 0, False, 0), EnvCopy(1, 0, 1, False, 1)]
    assert taken == {0, 1}
    copies.close()
    assert not taken


@pytest.mark.parametrize(
    ("env", "kwargs", "lane"),
    [("Asks-v0", {}, 1), ("Asks-v0", {"k": 4}, 0), ("tests.support.envs.toy:Countdown-v0", {}, 0)],
    ids=["of another lane", "with other arguments", "of another environment"],
)
def test_a_copy_that_was_described_and_is_not_the_next_one_is_closed_first(
    env: str, kwargs: dict[str, Any], lane: int, taken: set[int]
) -> None:
    """So that it takes no place on its machine, such as a licence."""
    describe(Describe(1, 1, EnvSpec(env, kwargs)))
    Asks.made.clear()
    copies = open_env_copies(run_with(), lane, no_pulse)
    assert Asks.made == [EnvCopy(2 * lane + copy, lane, copy, False, copy) for copy in range(2)]
    copies.close()
    assert not taken


def test_the_next_copy_that_is_described_takes_the_place_of_the_last_one(taken: set[int]) -> None:
    for _ in range(2):
        describe(Describe(1, 1, EnvSpec("Asks-v0")))
    assert Asks.made == [EnvCopy(slot=0)] * 2
    close_described()
    assert not taken


def test_a_described_copy_that_never_asked_which_it_is_is_any_copy(monkeypatch: pytest.MonkeyPatch, taken: set[int]) -> None:
    env = EnvSpec("tests.support.envs.toy:Countdown-v0", {"k": 3})
    run = replace(run_with(), env=env)
    made: list[gymnasium.Env[Any, Any]] = []
    make = EnvSpec.make

    def counted(self: EnvSpec, render_mode: str | None = None) -> Any:
        made.append(make(self, render_mode))
        return made[-1]

    monkeypatch.setattr(EnvSpec, "make", counted)
    describe(Describe(1, 1, env))
    lane = open_env_copies(run, 3, no_pulse)
    assert (len(made), taken) == (2, {0, 1})
    lane.close()
    describe(Describe(1, 1, env))
    evaluation = open_looped_copies(run, 1, None, no_pulse)
    assert (len(made), taken) == (3, {0})
    evaluation.close()
    assert not taken


def test_only_the_thread_that_has_described_a_copy_uses_it(taken: set[int]) -> None:
    """Workers over inproc are threads of one process."""
    describe(Describe(1, 1, EnvSpec("Asks-v0")))
    other = threading.Thread(target=lambda: open_env_copies(run_with(), 0, no_pulse).close())
    other.start()
    other.join(20)
    assert len(Asks.made) == 3
    close_described()


def test_the_slot_of_a_copy_that_cannot_be_made_is_not_free_because_its_constructor_may_have_started_something(
    taken: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Asks, "fails_at", 1)
    with pytest.raises(UsageError, match="no licence"):
        open_env_copies(run_with(), 0, no_pulse)
    assert taken == {1}
    monkeypatch.setattr(Asks, "fails_at", 0)
    with pytest.raises(millrace.EnvironmentFailed, match="no licence"):
        describe(Describe(1, 1, EnvSpec("Asks-v0")))
    assert taken == {0, 1}


@pytest.mark.parametrize("steps", [8, 12])  # two or three episodes, so that either instance plays at the end
def test_the_second_instance_of_a_copy_has_a_slot_of_its_own(taken: set[int], steps: int) -> None:
    run = run_with()
    env = EnvSpec.of("Asks-v0", wrappers=[ResetAhead])
    copies = open_env_copies(RunSpec(env, run.policy, 8, copies=1, lanes=8, seed=1), 4, no_pulse)
    copies.reset([1], no_pulse)
    for _ in range(steps):
        copies.step(np.zeros(1, np.int64), no_pulse)
    assert Asks.made == [EnvCopy(4, 4, 0, False, 0), EnvCopy(4, 4, 0, False, 1)]
    copies.close()
    assert not taken


# ----------------------------------------------------------------------------------------- when no copy is being made


def test_a_program_that_makes_its_environment_itself_has_one_slot(taken: set[int], monkeypatch: pytest.MonkeyPatch) -> None:
    gymnasium.make("Asks-v0")
    assert Asks.made == [EnvCopy(slot=0)]
    assert millrace.env_copy() == EnvCopy(slot=0)
    assert taken == {0}
    with monkeypatch.context() as fork:
        fork.setattr(os, "getpid", lambda: -1)
        assert millrace.env_copy() == EnvCopy(slot=1)


def test_who_asks_too_late_is_not_told_that_it_is_number_0() -> None:
    copies = open_env_copies(run_with(), 1, no_pulse)
    with pytest.raises(UsageError, match=r"^env_copy: this thread is not making an env copy now; ask in the environment's"):
        millrace.env_copy()
    copies.close()
    assert millrace.env_copy().number == 0


def test_each_thread_makes_its_own_copy() -> None:
    meet = threading.Barrier(2, timeout=20)

    def make() -> gymnasium.Env[Any, Any]:
        meet.wait()
        found.append(millrace.env_copy())
        meet.wait()
        return Countdown(3)

    found: list[EnvCopy] = []
    threads = [threading.Thread(target=copy_slots.make_copy, args=(EnvCopy(number), make)) for number in (5, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert {(copy.number, copy.slot) for copy in found} in ({(5, 0), (9, 1)}, {(5, 1), (9, 0)})
