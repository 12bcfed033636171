"""The two pure halves talk over a hostile network, thousands of times, and every rule holds after every event."""

from __future__ import annotations

import random

import pytest

from tests.support.conversation.fake_ends import Faults, World
from tests.support.conversation.rules import pending_evaluation

BLOCKS, CASES = 25, 80


def case(seed: int) -> World:
    """A world drawn at random: every fault, any number of workers, synchronous or not."""
    draw = random.Random(seed)
    lanes = draw.randint(1, 5)
    until_s = draw.uniform(3, 15)
    faults = Faults(
        loss=draw.choice([0.0, 0.0, 0.05, 0.3]),
        repeat=draw.choice([0.0, 0.2]),
        delay_s=draw.choice([0.01, 0.1, 0.8]),
        spoiled=draw.choice([0.0, 0.0, 0.05]),
        deaths=draw.randint(0, 4),
        freezes=draw.randint(0, 3),
        late_joiners=draw.randint(0, 2),
        leaves=draw.randint(0, 1),
        learner_restarts=draw.choice([0, 0, 1, 2]),
        evaluations=draw.choice([0.0, 0.5]),
        until_s=until_s,
    )
    workers, max_lag, evaluators = draw.randint(1, 4), draw.choice([0, 0, 1, 4]), draw.choice([None, None, 0, 1, 2])
    faults.places = draw.choice([0, 0, 1, 3])
    return World(seed, faults, workers=workers, lanes=lanes, max_lag=max_lag, evaluators=evaluators)


IN_MAKE_TEST = 1  # block; `make soak` runs the others


@pytest.mark.parametrize(
    "block", [*range(IN_MAKE_TEST), *(pytest.param(n, marks=pytest.mark.soak) for n in range(IN_MAKE_TEST, BLOCKS))]
)
def test_every_rule_holds_over_a_hostile_network(block: int) -> None:
    for seed in range(block * CASES, (block + 1) * CASES):
        world = case(seed)
        try:
            world.play(updates=12)
        except Exception as error:
            raise AssertionError(f"case {seed} at {world.now:.3f} s: {error!r}") from error


def test_without_faults_nothing_is_lost_or_said_twice() -> None:
    world = World(1, Faults(until_s=0.0), workers=2, lanes=4, max_lag=0)
    world.play(updates=200)
    counts = world.coordinator.rollouts.ledger.counts()
    assert counts["lost"] == counts["transitions_duplicate"] == counts["transitions_late"] == 0
    assert counts["used"] == 4 * 200


@pytest.mark.parametrize("evaluators", [None, 0, 2])
@pytest.mark.parametrize("shares", [0.0, 0.5])
def test_every_version_can_be_evaluated_although_workers_die_and_messages_are_lost(
    evaluators: int | None, shares: float
) -> None:
    faults = Faults(0.1, 0.2, deaths=6, freezes=4, late_joiners=2, evaluations=1.0, shares=shares, until_s=20.0)
    world = World(3, faults, workers=3, lanes=2, max_lag=1, evaluators=evaluators)
    world.play(updates=61, limit_s=4000.0)
    assert world.evaluations >= 59  # those of the last two updates may be pending
    assert (world.shared > 0) == (shares > 0)


def test_a_worker_without_a_lane_evaluates_too() -> None:
    """One lane and two workers: with the second as a spare, two orders of 0.2 s take no longer than one."""
    world = World(3, Faults(evaluations=1.0, until_s=0.0), workers=2, lanes=1, max_lag=0)
    holders = set()
    check = world.check

    def watch() -> None:
        check()
        if world.plan is not None and len(world.plan.seeds) > 2 * world.plan.copies:
            holders.add(tuple(sorted(member.peer for member in pending_evaluation(world.coordinator).players)))

    world.check = watch  # type: ignore[method-assign]
    world.play(updates=20)
    assert (b"w0", b"w1") in holders


def test_lost_messages_cost_no_transition() -> None:
    """Loss alone, without a death: every rollout is said again until it arrives."""
    world = World(5, Faults(loss=0.05, until_s=0.0), workers=2, lanes=4, max_lag=1)
    world.coordinator.worker_timeout_s = 1e9
    world.play(updates=100, limit_s=4000.0)
    assert world.coordinator.rollouts.ledger.lost == 0
    assert world.coordinator.rollouts.ledger.used == 4 * (100 + world.updating)
