"""An update that was not made whole is taken back: then the state is, bit for bit, that of before it."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import torch

from learner.algorithms import Algorithm, algorithm_class
from learner.config.layers import resolve
from protocol.env_spec import EnvSpec
from protocol.errors import RunError
from protocol.policy.policy import make_policy
from protocol.rollout import Batch, Rollout, stack_rollouts
from tests.support.described import run_spec
from workers.collect.collector import Collector
from workers.collect.held_rollouts import Assignment

ENV = "CartPole-v1"
SMALL: dict[str, Any] = {"rollout_steps": 16, "envs": 4, "lanes": 2, "net": (8,), "normalize_observations": True}
DQN = {"algo": "dqn", "replay_size": 100, "learning_starts": 1, "batch_size": 8, "gradient_steps": 6, "n_step": 2}
VARIANTS: dict[str, dict[str, Any]] = {
    "ppo": {"algo": "ppo", "n_epochs": 3, "batch_size": 16, "normalize_rewards": True, "learning_rate_schedule": "linear"},
    "a2c": {"algo": "a2c", "normalize_rewards": True},
    "impala": {"algo": "impala"},
    "reinforce": {"algo": "reinforce", "rollout_steps": 501, "envs": 2},
    "dqn, uniform": {**DQN, "replay": "uniform"},
    "dqn, prioritized": {**DQN, "replay": "prioritized", "amsgrad": True},
}


def algorithm_and_batches(settings: dict[str, Any], count: int) -> tuple[Algorithm, list[Batch]]:
    config = resolve(ENV, preset="none", **{**SMALL, **settings})
    run = run_spec(config, EnvSpec(ENV))
    algorithm = algorithm_class(config.algo)(config.algorithm, run.policy, total_steps=10_000, seed=1)
    collector = Collector(run, make_policy(run.policy))
    collector.load(*algorithm.weights())
    recorded: list[list[Rollout]] = []
    for sequence in range(count):
        lanes = [Assignment(sequence * run.lanes + lane, lane, 0, sequence) for lane in range(run.lanes)]
        recorded.append(collector.collect(lanes, 0, 1, lambda: None))
    collector.close_all()
    return algorithm, [stack_rollouts(rollouts) for rollouts in recorded]


def same(left: Any, right: Any) -> bool:
    match left:
        case dict():
            return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
        case list() | tuple():
            return len(left) == len(right) and all(map(same, left, right))
        case torch.Tensor():
            return torch.equal(left, right)
        case _:
            return bool(left == right)


class Stopped(Exception):
    pass


def stops_after(pulses: int) -> Any:
    left = [pulses]

    def pulse() -> None:
        left[0] -= 1
        if left[0] < 0:
            raise Stopped

    return pulse


@pytest.mark.parametrize("whole_updates", [0, 1, 4])  # with 4, the replay buffer of 100 slots has been overwritten
@pytest.mark.parametrize("variant", VARIANTS)
def test_an_update_that_stops_in_the_middle_leaves_nothing(variant: str, whole_updates: int) -> None:
    algorithm, batches = algorithm_and_batches(VARIANTS[variant], whole_updates + 2)
    for batch in batches[:whole_updates]:
        algorithm.remember()
        algorithm.update(batch, lambda: None)
    before, weights = algorithm.state_dict(), algorithm.weights()
    algorithm.remember()
    with pytest.raises(Stopped):
        algorithm.update(batches[whole_updates], stops_after(3 if "dqn" in variant or variant == "ppo" else 0))
    algorithm.roll_back()
    assert same(algorithm.state_dict(), before)
    assert all(map(np.array_equal, algorithm.weights(), weights))
    algorithm.remember()
    algorithm.update(batches[whole_updates], lambda: None)
    assert not same(algorithm.state_dict(), before), "the update changes nothing, so the test shows nothing"
    algorithm.roll_back()
    assert same(algorithm.state_dict(), before), "a whole update can be taken back too"


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_next_update_after_one_was_taken_back_is_the_same(variant: str) -> None:
    algorithm, batches = algorithm_and_batches(VARIANTS[variant], 4)
    other, _ = algorithm_and_batches(VARIANTS[variant], 0)
    for batch in batches[:2]:
        algorithm.update(batch, lambda: None)
        other.update(batch, lambda: None)
    algorithm.remember()
    algorithm.update(batches[2], lambda: None)
    algorithm.roll_back()
    assert algorithm.update(batches[3], lambda: None) == other.update(batches[3], lambda: None)
    assert same(algorithm.state_dict(), other.state_dict())


@pytest.mark.parametrize("variant", VARIANTS)
def test_weights_that_a_step_makes_infinite_are_noticed(variant: str) -> None:
    """The loss and the gradient are finite, but the step is not. The next step notices, or `is_finite` after the update."""
    largest = 1e38 if variant in ("a2c", "impala") else 1e300  # RMSprop takes no number that is too large for float32
    algorithm, batches = algorithm_and_batches({**VARIANTS[variant], "learning_rate": largest}, 1)
    before = algorithm.state_dict()
    assert algorithm.is_finite()
    with suppress(RunError):
        algorithm.update(batches[0], lambda: None)
    assert not algorithm.is_finite()
    algorithm.load_state_dict(before)
    assert algorithm.is_finite()
