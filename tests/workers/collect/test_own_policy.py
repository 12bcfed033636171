"""A policy of the user's own in a worker: one call for each lane, its state, what it returns, and what goes wrong in it."""

from __future__ import annotations

from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium import spaces

from millrace.own_policy import OwnPolicy as Declared
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import AllowedCode
from millrace.protocol.errors import PolicyFailed
from millrace.protocol.messages import Evaluate
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.rollout import Rollout
from millrace.protocol.specs import RunSpec
from millrace.workers.collect.collector import Collector
from millrace.workers.copies.env_copies import LoopedCopies
from millrace.workers.evaluate.evaluator import Evaluator
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import bits, collect, no_pulse, run_around, run_of
from tests.support.users_code.own_policies import ARRAYS, EXTRAS, Broken, Linear

HERE = "tests.support.users_code.own_policies:"
WEIGHTS = np.random.default_rng(0).normal(0, 0.3, 10).astype(np.float32)
NONE = np.zeros(0, np.float32)


def run_with(factory: Any = Linear, extras: Any = EXTRAS, T: int = 40, N: int = 3, **declared: Any) -> RunSpec:
    """A run of CartPole-v1 with this policy."""
    run = run_of("CartPole-v1", T=T, N=N)
    policy = Declared(factory, ARRAYS, extras, 1, **declared)
    spec = policy.spec(run.policy.observation, run.policy.action)
    return msgspec.structs.replace(run, policy=spec, extras=policy.extra_arrays)


def loaded(run: RunSpec) -> CalledPolicy:
    policy = CalledPolicy(run.policy, run.extras)
    policy.load(WEIGHTS, NONE)
    return policy


def all_bits(rollout: Rollout) -> dict[str, object]:
    return bits(rollout) | {"extras": [extra.tobytes() for extra in rollout.extras]}


def test_its_rows_hold_what_it_returned() -> None:
    run = run_with()
    (rollout,) = collect(Collector(run, loaded(run)), run)
    logits, side = rollout.extras
    assert logits.shape == (40, 3, 2)
    expected = rollout.obs[0][:-1] @ WEIGHTS[:8].reshape(4, 2) + WEIGHTS[8:]
    assert np.array_equal(logits, expected)
    assert np.array_equal(side, (expected[..., 0] > 0).astype(np.uint8))
    assert 0 < rollout.action.mean() < 1
    log_probs = expected - np.log(np.exp(expected).sum(-1, keepdims=True))
    chosen = np.take_along_axis(log_probs, rollout.action[..., None], -1)[..., 0]
    assert np.abs(chosen - rollout.log_prob).max() < 1e-6  # a few roundings of numbers below 2


def test_without_log_probs_there_are_zeros() -> None:
    run = run_with(Silent, {})
    (rollout,) = collect(Collector(run, loaded(run)), run)
    assert not rollout.log_prob.any()
    assert rollout.extras == ()


class Pairs:
    """Returns rows of a Tuple of a Discrete(3) and a Box of two numbers. `choice`: of all of them."""

    def __init__(self, choice: float) -> None:
        self.choice = choice

    def act(self, obs: Any, state: Any, rng: np.random.Generator) -> tuple[Any, Any, None]:
        return np.column_stack([np.full(len(obs), self.choice), rng.normal(size=(len(obs), 2))]), state, None


def run_of_pairs(choice: float) -> RunSpec:
    run = run_of("tests.support.envs.toy:Spaces-v0", kwargs={"action": "pair"})
    spec = Declared(Pairs, {}, kwargs={"choice": choice}).spec(run.policy.observation, run.policy.action)
    return msgspec.structs.replace(run, policy=spec)


def test_of_a_tuple_it_returns_rows_and_the_environment_gets_the_tuple() -> None:
    run = run_of_pairs(2)
    (rollout,) = collect(Collector(run, CalledPolicy(run.policy, ())), run)  # the toy checks its actions
    assert rollout.action.shape == (8, 2, 3)
    assert (rollout.action[..., 0] == 2).all()
    wrong = run_of_pairs(1.5)
    with pytest.raises(PolicyFailed, match=r"act: the action: expected 0 to 2, got 1.5 at copy 0"):
        collect(Collector(wrong, CalledPolicy(wrong.policy, ())), wrong)


class Shifts(gymnasium.Env[Any, Any]):
    """Adds 1 to its action in place."""

    def __init__(self) -> None:
        self.observation_space, self.action_space = spaces.Box(-1, 1, (2,)), spaces.MultiDiscrete([3, 3])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        action += 1
        return np.zeros(2, np.float32), 0.0, False, False, {}


class Ones:
    """Always takes the same action."""

    def load(self, arrays: dict[str, Array]) -> None:
        """Keep nothing."""

    def act(self, obs: Array, state: Array, rng: np.random.Generator) -> Any:
        return np.ones((len(obs), 2), np.int64), state, None


def test_an_environment_that_changes_its_action_does_not_change_the_rollout() -> None:
    run = run_around(Shifts(), 5)
    policy = Declared(Ones, {})
    run = msgspec.structs.replace(run, policy=policy.spec(run.policy.observation, run.policy.action))
    collector = Collector(run, CalledPolicy(run.policy, ()), lambda run, lane, pulse: LoopedCopies([Shifts], pulse))
    (rollout,) = collect(collector, run)
    assert (rollout.action == 1).all()


class Silent(Linear):
    """Returns the action alone."""

    def act(self, obs: Array, state: Array, rng: np.random.Generator) -> Any:
        return super().act(obs, state, rng)[0], state, None

    act_greedy = act


def test_lanes_together_or_apart_have_the_same_bits() -> None:
    run = run_with()
    together = Collector(run, loaded(run))
    apart = {lane: Collector(run, loaded(run)) for lane in (0, 1, 5)}
    for sequence in range(3):
        for rollout in collect(together, run, sequence, (5, 0, 1)):
            (alone,) = collect(apart[rollout.lane], run, sequence, (rollout.lane,))
            assert all_bits(rollout) == all_bits(alone)


def test_it_is_called_once_for_each_lane_with_exactly_its_copies() -> None:
    run, shapes = run_with(T=5), []
    policy = loaded(run)
    act = policy.act
    policy.act = lambda leaves, *rest, **more: (shapes.append(leaves[0].shape), act(leaves, *rest, **more))[1]  # type: ignore[func-returns-value,method-assign]
    collect(Collector(run, policy), run, lanes=(0, 3))
    assert shapes == [(3, 4)] * 10


def test_its_state_begins_anew_with_each_episode() -> None:
    run = run_with(T=60)
    collector, policy = Collector(run, loaded(run)), run.policy
    first, second = (collect(collector, run, sequence)[0] for sequence in range(2))
    assert policy.state_size == 1
    assert not first.state.any()
    steps = np.zeros(3)
    for t in range(60):
        steps += 1
        steps[~first.valid[t]] = 0  # the call on the reset's row does not count
    assert np.array_equal(second.state[:, 0], steps)


def test_an_evaluation_is_greedy_where_it_can_be() -> None:
    order = example(Evaluate, session=1, ticket=1, seeds=(5, 6, 7), greedy=True, most_steps=500)
    greedy, sampled = run_with(), run_with(Sampling)
    played = [Evaluator(run, loaded(run)).play(order, lambda rows: None, no_pulse).episodes for run in (greedy, sampled)]
    assert [each.length for each in played[0]] != [each.length for each in played[1]]
    again = Evaluator(greedy, loaded(greedy)).play(order, lambda rows: None, no_pulse).episodes
    assert [each.length for each in again] == [each.length for each in played[0]]


class Sampling(Linear):
    """One that cannot act greedily."""

    act_greedy = property()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("act raises", "policy Broken: act raised ZeroDivisionError: of the user's"),
        ("load raises", "policy Broken: load raised KeyError: 'w3'"),
        ("factory raises", "policy Broken: cannot be made: it raised ValueError: no such thing"),
        ("action shape", "act: the action: expected int64[3], got int64[1, 3]"),
        ("action dtype", "act: the action: expected int64[3], got float64[3]"),
        ("action range", "act: the action: expected 0 to 1, got 2 at copy 0"),
        ("state shape", "act: the state: expected float32[3, 1], got float32[3, 0]"),
        ("extra missing", "act: expected the extras log_prob, logits, side, got log_prob, logits"),
        ("extra unknown", "act: expected the extras log_prob, logits, side, got log_prob, logits, side, more"),
        ("extra shape", "act: extra logits: expected float32[3, 2], got float32[3, 1]"),
        ("extra nan", "act: extra logits: expected finite values, got nan at copy 1"),
        ("nothing", "act: expected it to return action, state, extras; got NoneType"),
    ],
)
def test_what_goes_wrong_in_it_is_named(wrong: str, message: str) -> None:
    run = run_with(Broken, kwargs={"wrong": wrong})
    with pytest.raises(PolicyFailed) as raised:
        collect(Collector(run, loaded(run)), run)
    assert message in str(raised.value)
    assert ("own_policies.py" in raised.value.detail) == ("raises" in wrong)  # the traceback, where there is one


@pytest.mark.parametrize(
    ("factory", "message"),
    [
        ("no_such_module:make", "no module named no_such_module; is it installed, or its folder on PYTHONPATH?"),
        (HERE + "nothing", "module tests.support.users_code.own_policies has no nothing"),
        (HERE + "not_a_policy", "expected an object with load and act, got int without load"),
    ],
)
def test_a_factory_that_cannot_be_used_is_named(factory: str, message: str) -> None:
    with pytest.raises(PolicyFailed) as raised:
        loaded(run_with(factory))
    assert str(raised.value) == f"policy {factory}: {message}"


def test_only_a_worker_that_knows_its_learner_calls_its_factory() -> None:
    function = run_with("subprocess:getoutput", kwargs={"cmd": "touch /tmp/never"})
    for run in (function, run_with(HERE + "Linear"), run_with(Linear)):
        for code in (AllowedCode.REGISTERED, AllowedCode.MODULES):
            assert "is a function or a class to call" in run.rejection_reason(code)
        assert not run.rejection_reason(AllowedCode.CALLABLES)
