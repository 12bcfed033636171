"""The collector: a lane gets the same bits alone and beside others; seeds, actions, opening and closing of lanes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any
from unittest.mock import Mock

import gymnasium
import msgspec
import numpy as np
import pytest
import torch
from gymnasium.wrappers import OrderEnforcing, TimeLimit

from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.protocol.arrays import Array
from millrace.protocol.messages import Permit
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.features import features
from millrace.protocol.policy.normalize import normalize
from millrace.protocol.specs import Leaf, RunSpec
from millrace.workers.collect.collector import Collector
from millrace.workers.copies.env_copies import copy_seed
from tests.support.envs.toy import Countdown, Scripted
from tests.support.in_process.collectors import (
    TOY,
    bits,
    collect,
    loop_over,
    no_pulse,
    random_collector,
    random_policy,
    random_weights,
    run_around,
    run_of,
)
from tests.support.numbers.rounding import in_double, in_float64, sampled

# ------------------------------------------------------------------------------------------------ the same bits


SPACES = f"{TOY}Spaces-v0"
DISCRETE, GAUSSIAN = run_of("CartPole-v1"), run_of("Pendulum-v1")
LSTM, GRU = run_of("CartPole-v1", core="lstm", core_size=9), run_of(f"{TOY}Recall-v0", core="gru", net=())
TABLE = run_of(SPACES, kwargs={"observation": "dict", "action": "table"}, normalize_observations=True)
BITS = run_of(SPACES, kwargs={"observation": "bytes", "action": "multibinary"}, activation="relu")


@pytest.mark.parametrize("copies", [1, 2, 5, 17])
@pytest.mark.parametrize(
    "run", [DISCRETE, GAUSSIAN, TABLE, BITS, LSTM, GRU], ids=["discrete", "gaussian", "table", "bits", "lstm", "gru"]
)
def test_a_lane_collects_the_same_bits_alone_and_beside_others(run: RunSpec, copies: int) -> None:
    run = msgspec.structs.replace(run, copies=copies, rollout_steps=5)
    together, apart = random_collector(run), random_collector(run)
    for k, lanes in enumerate([range(7), (4, 1), range(6, -1, -1)]):
        for rollout in collect(together, run, k, lanes):
            if rollout.lane in (1, 4):
                assert bits(rollout) == bits(collect(apart, run, k, [rollout.lane])[0])


def random_leaf(leaf: Leaf, generator: np.random.Generator, lead: tuple[int, ...]) -> Array:
    """Observations [*lead, *leaf] from everywhere in the space."""
    if leaf.sizes:
        flat = generator.integers(leaf.start, np.add(leaf.start, leaf.sizes), (*lead, len(leaf.sizes)))
        return flat.reshape(*lead, *leaf.shape)
    return generator.normal(100, 50, (*lead, *leaf.shape)).clip(0, 255).astype(leaf.dtype)


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("run", [DISCRETE, GAUSSIAN, TABLE, BITS], ids=["discrete", "gaussian", "table", "bits"])
def test_any_lanes_of_any_size_act_the_same_alone_and_beside_others(run: RunSpec, activation: str) -> None:
    spec = msgspec.structs.replace(run.policy, activation=activation)
    chosen = distribution(spec)
    policy = random_policy(spec)
    generator = np.random.default_rng(0)
    for N in range(1, 65):
        leaves = [random_leaf(leaf, generator, (7, 3, N))[:, 1] for leaf in spec.observation]  # not contiguous, as there
        noise = chosen.noise(generator, (7, N))
        params = policy(leaves)
        action = chosen.sample(params, noise)
        for lane in range(7):
            alone = policy([leaf[lane : lane + 1] for leaf in leaves])
            assert alone.tobytes() == params[lane].tobytes()
            assert chosen.sample(alone, noise[lane : lane + 1]).tobytes() == action[lane].tobytes()


def test_a_policy_acts_the_same_whatever_it_acted_on_before_and_does_not_change_its_results() -> None:
    generator = np.random.default_rng(0)
    given = [generator.normal(size=(L, N, 4)).astype(np.float32) for L, N in ((1, 3), (2, 3), (2, 8), (1, 3))]
    policy = random_policy(DISCRETE.policy)
    in_turn = [policy([obs]) for obs in given]
    assert [params.tobytes() for params in in_turn] == [random_policy(DISCRETE.policy)([obs]).tobytes() for obs in given]


def test_a_lane_does_not_depend_on_how_many_the_run_has() -> None:
    few, many = (msgspec.structs.replace(DISCRETE, lanes=lanes) for lanes in (1, 100))
    assert bits(collect(random_collector(few), few)[0]) == bits(collect(random_collector(many), many)[0])


# ------------------------------------------------------------------------------------------------ seeds


def test_every_copy_of_every_incarnation_of_every_lane_has_its_own_seed() -> None:
    seeds = [
        seed
        for run_seed in (0, 1)
        for lane in range(8)
        for start in range(3)
        for seed in [copy_seed(run_seed, lane, start, copy) for copy in range(16)]
    ]
    assert len(set(seeds)) == len(seeds) == 2 * 8 * 3 * 16
    assert all(0 <= seed < 2**31 for seed in seeds)


def test_copies_of_all_lanes_start_differently() -> None:
    run = run_of("CartPole-v1", T=2, N=4)
    firsts = [rollout.obs[0][0] for rollout in collect(random_collector(run), run, lanes=(0, 1, 2, 3))]
    assert len(np.unique(np.concatenate(firsts), axis=0)) == 16


def test_actions_of_lanes_and_rounds_are_drawn_independently() -> None:
    run = run_of(f"{TOY}Countdown-v0", T=64, N=2)
    collector = random_collector(run)
    rollouts = collect(collector, run, lanes=(0, 1)) + collect(collector, run, 1, lanes=(0, 1))
    assert len({rollout.action.tobytes() for rollout in rollouts}) == 4


# ------------------------------------------------------------------------------------------------ actions


def test_a_gaussian_action_is_stored_as_drawn_and_clipped_only_at_the_environment() -> None:
    run = run_of(f"{TOY}Spaces-v0", T=4, N=3, kwargs={"action": "box"})  # raises if an action is outside ±0.1
    (rollout,) = collect(random_collector(run), run)
    assert np.abs(rollout.action).max() > 0.2
    np.testing.assert_allclose(rollout.reward, np.clip(rollout.action, -0.1, 0.1).sum(-1), rtol=1e-6)


def test_actions_count_from_zero_and_the_environment_counts_from_start() -> None:
    run = run_of(f"{TOY}Spaces-v0", T=4, N=30, kwargs={"action": "offset"})
    (rollout,) = collect(random_collector(run), run)
    assert set(rollout.action.ravel().tolist()) == {0, 1, 2}
    assert (rollout.reward == rollout.action + 5).all()


class OverwritesActions(Countdown):
    """Records its actions, and overwrites them afterwards."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = gymnasium.spaces.MultiDiscrete([50, 50])
        self.given: list[Any] = []

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.given.append(action.copy())
        assert type(action) is np.ndarray
        assert action.dtype == np.int64
        action[:] = -1
        return super().step(action)


def test_an_environment_that_writes_into_its_action_does_not_change_the_rollout() -> None:
    env = OverwritesActions()
    run = run_around(env, T=4)
    (rollout,) = collect(random_collector(run, loop_over([lambda: env])), run)
    assert rollout.action[:, 0].tolist() == np.array(env.given).tolist()


@pytest.mark.parametrize("run", [DISCRETE, GAUSSIAN, TABLE, BITS], ids=["discrete", "gaussian", "table", "bits"])
def test_log_probabilities_are_those_of_the_policy_in_these_observations(run: RunSpec) -> None:
    (rollout,) = collect(random_collector(run), run)
    obs = [leaf[:-1] for leaf in rollout.obs]
    expected = distribution(run.policy).log_prob(random_policy(run.policy)(obs), rollout.action)
    parameters, buffers = random_weights(run.policy)
    x = features(run.policy, obs)
    x = normalize(x, *np.split(buffers, 2)) if run.policy.normalize_observations else x
    net = ActorCriticNetwork(run.policy)
    net.flat[: net.acting_size] = torch.tensor(parameters)
    exact, rows = in_float64(net), (x.reshape(-1, x.shape[-1]), rollout.action.reshape(-1, *rollout.action.shape[2:]))
    x64, action = (in_double(torch.tensor(each)) for each in rows)
    (of_log_prob,) = sampled(lambda: [exact.evaluate(x64, (), None, action)[0]])
    of_log_prob.assert_is(rollout.log_prob.ravel(), expected.ravel())


def test_arrays_are_contiguous_and_never_written_again() -> None:
    run = run_of(f"{TOY}Spaces-v0", T=3, N=2, kwargs={"observation": "dict"})
    collector = random_collector(run)
    rollouts = collect(collector, run, 0, lanes=(0, 1))
    before = [bits(rollout) for rollout in rollouts]
    collect(collector, run, 1, lanes=(0, 1))
    assert [bits(rollout) for rollout in rollouts] == before
    for rollout in rollouts:
        arrays = [*rollout.obs, rollout.action, rollout.log_prob, rollout.reward, rollout.terminated, rollout.valid]
        assert all(array.flags.c_contiguous for array in arrays)


# ------------------------------------------------------------------------------------------------ lives of lanes


class Closable(Scripted):
    """Reports when it is closed, and cannot be used afterwards."""

    def __init__(self, said: list[str], name: str) -> None:
        super().__init__()
        self._said, self._name, self._closed = said, name, False

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert not self._closed
        return super().step(action)

    def close(self) -> None:
        self._closed = True
        self._said.append(self._name)
        raise RuntimeError("closing fails, too")


def closable(T: int = 4) -> tuple[RunSpec, Collector, list[str]]:
    """A collector with one copy for each lane, and the names of the copies closed so far, in order of making."""
    said: list[str] = []
    names = iter("abcdefgh")
    run = run_of(f"{TOY}Scripted-v0", T=T, N=1)
    return run, random_collector(run, lambda r, n, p: loop_over([partial(Closable, said, next(names))])(r, n, p)), said


class Doubled(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A wrapper that does something."""

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, 2 * float(reward), terminated, truncated, info


def test_copies_are_stepped_without_the_order_check_and_with_every_other_wrapper(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    guard = Mock()
    monkeypatch.setattr(OrderEnforcing, "step", guard)
    made = [
        lambda: TimeLimit(Doubled(OrderEnforcing(Doubled(Countdown()))), 3),
        lambda: OrderEnforcing(Doubled(Countdown())),
    ]
    run = run_of(f"{TOY}Countdown-v0", T=3, N=2)
    (rollout,) = collect(random_collector(run, loop_over(made)), run)
    assert rollout.reward.tolist() == [[4, 2]] * 3
    assert rollout.truncated.tolist() == [[False, False]] * 2 + [[True, False]]
    assert not guard.called


def test_lanes_are_closed_when_released_or_started_anew() -> None:
    run, collector, said = closable()
    collect(collector, run, lanes=(0, 1, 2))
    collect(collector, run, 1, lanes=(0, 1, 2))
    assert said == []
    collect(collector, run, lanes=(1,), incarnation=1)
    assert said == ["b"]
    collector.lanes.close([2, 7])
    assert said == ["b", "c"]
    collector.lanes.close_all()
    assert sorted(said) == ["a", "b", "c", "d"]


def test_a_pulse_may_abandon_the_collection() -> None:
    class Enough(Exception):
        pass

    pulses = 0

    def pulse() -> None:
        nonlocal pulses
        pulses += 1
        if pulses == 6:
            raise Enough

    run, collector, said = closable(T=50)
    collect(collector, run, lanes=(2,))
    with pytest.raises(Enough):
        collector.collect([Permit(0, 0, 0, 0, 0), Permit(1, 1, 0, 0, 0)], 0, 0, pulse)
    assert sorted(said) == ["b", "c"]
    collect(collector, run, 1, lanes=(2,))  # lane 2 goes on,
    assert collector.steps == 80 + 2  # two lanes had made a step each when they were abandoned
    collect(collector, run, lanes=(0,))  # and lane 0 can begin again


def test_a_lane_released_by_a_pulse_is_closed_after_the_collection() -> None:
    _, collector, said = closable()
    collector.collect([Permit(0, 0, 0, 0, 0), Permit(1, 1, 0, 0, 0)], 0, 0, lambda: collector.lanes.close([1]))
    assert said == ["b"]


def test_a_lane_released_while_its_copies_are_made_is_closed_after_the_collection() -> None:
    run, said = run_of(f"{TOY}Scripted-v0", T=4, N=1), list[str]()

    def make(lane: int) -> Closable:
        if lane == 1:
            collector.lanes.close([1])
        return Closable(said, "ab"[lane])

    collector = random_collector(run, lambda r, n, p: loop_over([partial(make, n)])(r, n, p))
    collect(collector, run, lanes=(0, 1))
    assert said == ["b"]
    collector.lanes.close_all()
    assert said == ["b", "a"]


def test_the_pulse_is_called_between_slow_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("millrace.workers.copies.env_loop.PULSE_S", -1.0)  # any step is a slow one
    run = run_of(f"{TOY}Countdown-v0", T=3, N=5)
    pulses: list[int] = []
    random_collector(run).collect([Permit(0, 0, 0, 0, 0)], 0, 0, lambda: pulses.append(1))
    assert len(pulses) >= 3 * 5


def test_one_lane_cannot_be_collected_twice_at_once() -> None:
    run = run_of(f"{TOY}Countdown-v0")
    with pytest.raises(ValueError, match="one permit for each lane"):
        random_collector(run).collect([Permit(0, 3, 0, 0, 0), Permit(1, 3, 0, 1, 1)], 0, 0, no_pulse)


def test_stages_and_steps_are_counted() -> None:
    run = run_of(f"{TOY}Countdown-v0", T=7, N=2, kwargs={"k": 100})
    collector = random_collector(run)
    collect(collector, run, lanes=(0, 1))
    assert collector.steps == 28
    assert collector.stages.keys() == {"open", "act", "step"}
    assert min(collector.stages.values()) > 0


@pytest.mark.parametrize("env", ["Scripted", "Countdown"])
@pytest.mark.parametrize("lanes", [(0,), (0, 1)])
def test_steps_are_counted_while_a_rollout_is_under_way(
    env: str, lanes: Sequence[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also between the copies of one lane, whose step may take minutes; resets are no steps."""
    monkeypatch.setattr("millrace.workers.copies.env_loop.PULSE_S", -1.0)  # any step is a slow one
    run = run_of(f"{TOY}{env}-v0", T=9, N=3)
    made = 0

    def counted(step: Callable[..., Any]) -> Callable[..., Any]:
        def stepped(env: Any, action: Any) -> Any:
            nonlocal made
            made += 1
            return step(env, action)

        return stepped

    toy: type[Scripted | Countdown] = {"Scripted": Scripted, "Countdown": Countdown}[env]
    monkeypatch.setattr(toy, "step", counted(toy.step))
    collector, seen = random_collector(run), list[tuple[int, int]]()
    for k in range(3):
        pulse = lambda: seen.append((collector.steps, made))  # noqa: E731
        collector.collect([Permit(10 * k + lane, lane, 0, k, k) for lane in lanes], 0, 0, pulse)
        assert collector.steps == made
    reported = [steps for steps, _ in seen]
    assert reported == sorted(reported)
    assert all(made - len(lanes) * run.copies < steps <= made for steps, made in seen)  # resets of a row may come first
    assert len(set(reported)) > 3 * run.rollout_steps  # more than one count in a row


@pytest.mark.process
def test_collecting_imports_no_torch_for_an_mlp() -> None:
    program = "import sys, millrace.workers.collect.collector; sys.exit('torch' in sys.modules or 'learner' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], timeout=60, check=False).returncode == 0
