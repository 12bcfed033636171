"""The update without a graph is the update with one: outputs, gradients, losses, each step; and when it is chosen."""

from __future__ import annotations

import itertools
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.algorithms import algorithm_class, losses
from learner.algorithms.actor_critic import Estimates
from learner.algorithms.kernels import loss_gradients
from learner.algorithms.kernels import mlp as layers
from learner.algorithms.kernels.fused import FusedActorCritic, can_fuse
from learner.algorithms.minibatches import Minibatch
from learner.algorithms.ppo import PPO
from learner.config.hyperparameters import HYPERPARAMETERS, PPOConfig
from protocol.arrays import Array
from protocol.policy.layout import parameter_layout, total_size
from protocol.policy.networks import ActorCriticNetwork
from protocol.policy.torch_distributions import log_prob_and_entropy
from protocol.specs import ActionSpec, Leaf, PolicySpec
from tests.protocol.policy.test_networks import ACTIONS
from tests.support.batches import DISCRETE, GAUSSIAN, IMAGE, batch, no_pulse, normal, recurrent, shared
from tests.support.finite_differences import is_the_slope
from tests.support.rounding import (
    actor_critic_tolerance,
    assert_within,
    value_tolerance,
)
from tests.support.steps import gradient_tolerance

BOX = (Leaf("", "box", (4,), "float32"),)


def some_actions(spec: ActionSpec, rows: int, generator: np.random.Generator) -> Array:
    if spec.kind == "box":
        return generator.normal(size=(rows, *spec.shape)).astype(np.float32)
    high = np.reshape(spec.sizes, spec.shape) if spec.sizes else 2
    return generator.integers(0, high, (rows, *spec.shape))


def make(spec: PolicySpec, seed: int, scale: float = 0.4) -> tuple[ActorCriticNetwork, FusedActorCritic]:
    net = ActorCriticNetwork(spec)
    net.flat.copy_(torch.tensor(np.random.default_rng(seed).normal(0, scale, len(net.flat)), dtype=torch.float32))
    return net, FusedActorCritic(spec, net.flat.numpy(), net.flat_grad.numpy())


@given(
    st.sampled_from(sorted(ACTIONS)),
    st.sampled_from(["tanh", "relu"]),
    st.lists(st.integers(1, 9), max_size=3),
    st.booleans(),
    st.integers(1, 40),
    st.sampled_from([512, 7, 1]),
    st.booleans(),
    st.integers(0, 2**32),
)
@settings(max_examples=300, deadline=None)
def test_outputs_and_gradients_are_autograds(
    action: str, activation: Any, net: list[int], shared_net: bool, rows: int, piece: int, by_torch: bool, seed: int
) -> None:
    with patch.multiple(layers, CHUNK_ROWS=piece, uses_torch=lambda _: by_torch):
        outputs_and_gradients(PolicySpec(BOX, ACTIONS[action], tuple(net), activation, shared_net=shared_net), rows, seed)


@pytest.mark.parametrize("rows", [64, 129, 513, 2048])
@pytest.mark.parametrize("shared_net", [False, True])
def test_so_they_are_at_the_sizes_that_are_used(rows: int, shared_net: bool) -> None:
    outputs_and_gradients(PolicySpec(BOX, ACTIONS["discrete"], (64, 64), shared_net=shared_net), rows, 0)


def test_the_tolerance_of_values_is_exceeded_if_a_single_term_is_lost() -> None:
    for net_size in ((), (5,), (64, 64)):
        spec = PolicySpec(BOX, ACTIONS["discrete"], net_size)
        net, fused = make(spec, 0)
        x = np.random.default_rng(0).normal(size=(64, 4)).astype(np.float32)
        before, tolerance = fused.value(x).copy(), value_tolerance(net, x)
        for name in [name for name in net.parameters if name.startswith("critic") and name.endswith("weight")]:
            with torch.no_grad():
                lost = net.parameters[name][0, -1].clone()
                net.parameters[name][0, -1] = 0
                assert (np.abs(fused.value(x) - before) > 10 * tolerance).mean() > 0.8, name
                net.parameters[name][0, -1] = lost


def outputs_and_gradients(spec: PolicySpec, rows: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    with_graph, fused = make(spec, seed)
    x, taken = generator.normal(size=(rows, 4)).astype(np.float32), some_actions(spec.action, rows, generator)
    params, value = with_graph.forward(torch.tensor(x))
    expected = (*log_prob_and_entropy(spec.action, params, torch.tensor(taken)), value)
    found = fused.forward(x, taken)
    tolerance = value_tolerance(with_graph, x)
    assert_within(fused.value(x), found[2], tolerance)
    assert_within(found[2], value.detach().numpy(), tolerance)
    given_back = [generator.normal(size=rows).astype(np.float32) for _ in range(3)]
    allowed = actor_critic_tolerance(spec, with_graph.flat.numpy(), x, taken, given_back)
    assert_within(found[0], expected[0].detach().numpy(), allowed.log_prob)
    assert_within(found[1], expected[1].detach().numpy(), allowed.entropy)
    with_graph.flat_grad.zero_()
    torch.autograd.backward(expected, [torch.tensor(each) for each in given_back])
    reference = with_graph.flat_grad.numpy().copy()
    with_graph.flat_grad.fill_(7.0)  # every gradient is written, none added to
    fused.backward(*given_back)
    assert_within(with_graph.flat_grad.numpy(), reference, allowed.gradient)


@pytest.mark.parametrize("action", sorted(ACTIONS))
@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("shared_net", [False, True])
@pytest.mark.parametrize(("piece", "by_torch"), [(512, False), (4, True)])
def test_the_gradient_is_the_slope_in_float64(
    action: str, activation: Any, shared_net: bool, piece: int, by_torch: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Central differences of a weighted sum of all outputs, by every parameter."""
    monkeypatch.setattr(layers, "CHUNK_ROWS", piece)
    monkeypatch.setattr(layers, "uses_torch", lambda _: by_torch)
    generator = np.random.default_rng(3)
    spec = PolicySpec(BOX, ACTIONS[action], (5, 3), activation, shared_net=shared_net)
    flat = generator.normal(0, 0.5, sum(map(total_size, parameter_layout(spec))))
    grad = np.full_like(flat, np.nan)
    fused = FusedActorCritic(spec, flat, grad)
    x, taken = generator.normal(size=(6, 4)), some_actions(spec.action, 6, generator)
    weights = generator.normal(size=(3, 6))

    def total() -> float:
        return float(sum((w * out).sum() for w, out in zip(weights, fused.forward(x, taken), strict=True)))

    total()
    fused.backward(*weights.copy())
    is_the_slope(grad, total, flat, 1e-6)


PPO_LOSSES = ("clipped surrogate", "policy gradient"), ("squared", "clipped"), (0.0, 0.02)


@pytest.mark.parametrize(("policy_loss", "value_loss", "ent_coef"), list(itertools.product(*PPO_LOSSES)))
def test_the_gradient_of_every_loss_is_its_slope_in_float64(policy_loss: str, value_loss: str, ent_coef: float) -> None:
    generator, rows = np.random.default_rng(4), 8
    spec = PolicySpec(BOX, ACTIONS["discrete"], (5, 3))
    flat = generator.normal(0, 0.5, sum(map(total_size, parameter_layout(spec))))
    grad = np.full_like(flat, np.nan)
    fused = FusedActorCritic(spec, flat, grad)
    x, taken = generator.normal(size=(rows, 4)), some_actions(spec.action, rows, generator)
    before, advantage = -1.4 + 0.4 * generator.normal(size=rows), losses.standardized(generator.normal(size=rows))
    target, value_before = generator.normal(size=(2, rows))

    def loss_and_gradients() -> tuple[float, tuple[Array, Array, Array]]:
        log_prob, entropy, value = fused.forward(x, taken)
        if policy_loss == "policy gradient":
            first, by_log_prob = loss_gradients.policy_gradient(log_prob, advantage)
        else:
            first, by_log_prob = loss_gradients.clipped_surrogate(losses.ratio(log_prob, before)[1], advantage, 0.2)
        if value_loss == "squared":
            second, by_value = loss_gradients.value_loss(value, target)
        else:
            second, by_value = loss_gradients.clipped_value_loss(value, target, value_before, 0.5)
        third, by_entropy = loss_gradients.entropy_loss(entropy)
        return float(first + 0.5 * second + ent_coef * third), (by_log_prob, ent_coef * by_entropy, 0.5 * by_value)

    fused.backward(*loss_and_gradients()[1])
    is_the_slope(grad, lambda: loss_and_gradients()[0], flat, 1e-7)


@pytest.mark.parametrize("action", sorted(ACTIONS))
@pytest.mark.parametrize("rows", [64, 256, 2048])
def test_in_float32_it_is_as_near_to_float64_as_rounding_allows(action: str, rows: int) -> None:
    """The gradient of a mean over rows, by the kernels and by autograd: both within the bound that `rounding` derives."""
    spec = PolicySpec(BOX, ACTIONS[action], (64, 64))
    with_graph, fused = make(spec, 0, scale=0.1)
    generator = np.random.default_rng(1)
    x, taken = generator.normal(size=(rows, 4)).astype(np.float32), some_actions(spec.action, rows, generator)
    given_back = [(generator.normal(size=rows) / rows).astype(np.float32) for _ in range(3)]
    params, value = with_graph.forward(torch.tensor(x))
    outputs = (*log_prob_and_entropy(spec.action, params, torch.tensor(taken)), value)
    with_graph.flat_grad.zero_()
    torch.autograd.backward(outputs, [torch.tensor(each) for each in given_back])
    autograds = with_graph.flat_grad.numpy().copy()
    fused.forward(x, taken)
    fused.backward(*given_back)
    flat = with_graph.flat.numpy().astype(np.float64)
    gradient = np.empty_like(flat)
    exact = FusedActorCritic(spec, flat, gradient)

    def truth(by_outputs: list[Array]) -> Array:
        exact.forward(x.astype(np.float64), taken)
        exact.backward(*(each.astype(np.float64) for each in by_outputs))
        return gradient.copy()

    expected = truth(given_back)
    allowed = actor_critic_tolerance(spec, with_graph.flat.numpy(), x, taken, given_back).gradient
    for found in (with_graph.flat_grad.numpy(), autograds):
        assert_within(found, expected, allowed)
    without_a_row = [np.where(np.arange(rows) == 7, 0, each) for each in given_back]
    assert (np.abs(truth(without_a_row) - expected) > allowed).mean() > 0.9  # the loss of a single row would show


SETTINGS: list[tuple[str, dict[str, Any]]] = [
    ("ppo", {"ent_coef": 0.01, "batch_size": 32}),
    ("ppo", {"clip_range_vf": 0.1, "normalize_advantage": False, "max_grad_norm": 0.1}),
    ("ppo", {"target_kl": 0.01, "shared_net": True}),
    ("a2c", {"ent_coef": 0.01, "normalize_advantage": True, "optimizer": "adam"}),
    ("impala", {"n_epochs": 2, "minibatches": 3}),
    ("reinforce", {"ent_coef": 0.01, "rollout_steps": 20}),
]


@pytest.mark.parametrize("spec", [DISCRETE, normal(GAUSSIAN)], ids=["discrete", "gaussian"])
@pytest.mark.parametrize(("name", "changes"), SETTINGS)
def test_every_gradient_is_the_same_by_kernels_by_hand_derived_gradients_and_by_autograd(
    name: str, changes: dict[str, Any], spec: PolicySpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In each step of three updates, with the weights and the minibatch of that step: errors do not add up."""
    config = msgspec.convert(changes, HYPERPARAMETERS[name])
    spec = shared(spec) if config.shared_net else spec  # type: ignore[attr-defined]
    built_in: Any = algorithm_class(name)
    of_its_own_loss: Any = type("OfItsOwnLoss", (built_in,), {"loss": built_in.loss})
    algorithm, *others = (kind(config, spec, total_steps=1_000, seed=0) for kind in (built_in, built_in, of_its_own_loss))
    assert [each._hand_derived for each in others] == [True, False]
    step, steps = algorithm.step, 0

    def checked_step(minibatch: Minibatch) -> dict[str, float]:
        nonlocal steps
        steps += 1
        assert isinstance(minibatch.features, np.ndarray)
        tolerance = gradient_tolerance(algorithm, minibatch)
        expected = algorithm._gradient(algorithm.evaluate(minibatch))
        in_torch = Minibatch(*(torch.from_numpy(part) if len(part) else () for part in minibatch[:6]))  # type: ignore[arg-type]
        for other in others:
            other.net.flat.copy_(algorithm.net.flat)
            other.env_steps = algorithm.env_steps
            other.set_schedules()
            metrics = other._gradient(other.evaluate(in_torch))
            assert_within(other.net.flat_grad.numpy(), algorithm.net.flat_grad.numpy(), tolerance)
            assert {each: metrics[each] for each in expected} == pytest.approx(expected, rel=1e-3, abs=1e-4)
        return step(minibatch)  # type: ignore[no-any-return]

    monkeypatch.setattr(algorithm, "step", checked_step)
    for seed in range(3):
        algorithm.update(batch(algorithm, seed, fresh=seed == 0), no_pulse)
    assert steps >= 3


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        (DISCRETE, True),
        (shared(GAUSSIAN), True),
        (IMAGE, False),
        (recurrent(DISCRETE, "gru"), False),
        (msgspec.structs.replace(DISCRETE, head="q"), True),
        (msgspec.structs.replace(DISCRETE, net=(64, 256)), True),
        (msgspec.structs.replace(DISCRETE, net=(64, 257)), False),
    ],
)
def test_it_is_for_small_layers_and_nothing_else(spec: PolicySpec, expected: bool) -> None:
    assert can_fuse(spec) == expected


def test_sizes_of_minibatches_come_and_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layers, "MAX_PLANS", 30)
    spec = PolicySpec(BOX, ACTIONS["discrete"], (5,))
    net, fused = make(spec, 0)
    x = np.random.default_rng(0).normal(size=(99, 4)).astype(np.float32)
    whole, tolerance = fused.value(x).copy(), value_tolerance(net, x)
    for rows in (*range(1, 99), 40, 2):
        assert_within(fused.value(x[:rows]), whole[:rows], tolerance[:rows])
        assert len(fused._critic_mlp._plans) <= 30
    assert {40, 2} <= set(fused._critic_mlp._plans)


def test_sizes_of_minibatches_share_their_memory() -> None:
    """And give the bits that they would give alone, whichever came before."""
    spec = PolicySpec(BOX, ACTIONS["discrete"], (32,))
    _, fused = make(spec, 0)
    x = np.random.default_rng(0).normal(size=(2 * layers.CHUNK_ROWS, 4)).astype(np.float32)
    action = np.zeros((len(x), 1), np.int64)
    for rows in (200, 256, 255, 2 * layers.CHUNK_ROWS, 256, 1, 255):
        _, alone = make(spec, 0)
        for found in (alone, fused):
            found.forward(x[:rows], action[:rows])
        ones = np.ones(rows, np.float32)
        gradients = []
        for found in (alone, fused):
            said = [each.copy() for each in found.forward(x[:rows], action[:rows])]
            found.backward(ones, ones, ones)
            gradients.append([*said, *(layer.weight_grad.copy() for layer in found._mlp._hidden)])
        for one, other in zip(*gradients, strict=True):
            np.testing.assert_array_equal(one, other)
    passes = fused._mlp._plans
    assert np.shares_memory(passes[256].head_outputs[0], passes[255].head_outputs[0])
    assert sum(array.nbytes for array in fused._mlp._workspace._arrays) < 3 * 4 * 2 * layers.CHUNK_ROWS * (4 + 4 * 32 * 2)


def test_large_minibatches_keep_the_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds: list[type] = []
    for most in (30, 29):
        monkeypatch.setattr("learner.algorithms.actor_critic.MAX_ROWS", most)
        algorithm = PPO(PPOConfig(batch_size=30, n_epochs=1), DISCRETE, total_steps=1, seed=0)
        rows = batch(algorithm, 0)
        estimates = Estimates(rows.reward, rows.reward, rows.reward, rows.valid, {})
        all_rows = algorithm.rows(rows, algorithm.observations(rows), estimates)
        mask = np.zeros_like(rows.valid)
        mask.reshape(-1)[:60] = True
        kinds.append(type(next(algorithm.minibatches(all_rows, mask, 2)).features))
    assert kinds == [np.ndarray, torch.Tensor]
