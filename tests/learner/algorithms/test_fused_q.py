"""Action values without a graph are those with one: outputs, gradients, options, each step; and when it is chosen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.algorithms.dqn import DQN, LOSSES, StepMetrics
from learner.algorithms.kernels import fused
from learner.algorithms.kernels import mlp as layers
from learner.algorithms.kernels.action_values import AutogradActionValues, FusedActionValues, action_values
from learner.algorithms.kernels.fused import FusedQNetwork
from learner.algorithms.replay.replay_buffer import Sample
from learner.config.hyperparameters import DQNConfig
from protocol.arrays import Array
from protocol.policy.layout import hidden_names, parameter_layout, total_size
from protocol.policy.networks import QNetwork
from protocol.specs import PolicySpec
from tests.learner.algorithms.test_dqn import batch, error_variance, gradient_tolerance
from tests.support.batches import BOX, DISCRETE, IMAGE, no_pulse
from tests.support.finite_differences import is_the_slope
from tests.support.rounding import (
    UNIT,
    assert_within,
    forward_tolerance,
    network_layers,
    q_gradient_tolerance,
    tolerance_of,
)


def policy(net: tuple[int, ...], activation: Any = "tanh", dueling: bool = False) -> PolicySpec:
    return msgspec.structs.replace(DISCRETE, head="q", net=net, activation=activation, dueling=dueling)


def outputs_and_gradients(spec: PolicySpec, rows: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    net = QNetwork(spec)
    net.flat.copy_(torch.tensor(generator.normal(0, 0.4, len(net.flat)), dtype=torch.float32))
    x, by_value = generator.normal(size=(rows, 4)), generator.normal(size=(4, rows))
    values = net.params(torch.tensor(x, dtype=torch.float32))
    net.flat_grad.zero_()
    torch.autograd.backward(values, torch.tensor(by_value.T, dtype=torch.float32))
    expected = net.flat_grad.numpy().copy()
    net.flat_grad.fill_(7.0)  # every gradient is written, none added to
    without = FusedQNetwork(spec, net.flat.numpy(), net.flat_grad.numpy())
    found = without.forward(x.astype(np.float32))
    tops = ("q.out", "q.value") if spec.dueling else ("q.out",)
    trunk = hidden_names(spec)
    parts = [network_layers(net.parameters, [*trunk, top]) for top in tops]
    tolerance, *of_value = (forward_tolerance(part, x, spec.activation == "relu") for part in parts)
    if of_value:  # Q = V + A − mean A
        tolerance = tolerance + of_value[0] + tolerance.mean(1, keepdims=True) + 8 * UNIT * np.abs(found).max()
    assert_within(found, values.detach().numpy().T, tolerance.T)
    without.backward(by_value.astype(np.float32))
    assert_within(net.flat_grad.numpy(), expected, q_gradient_tolerance(spec, net.flat.numpy(), x, by_value.T))


@given(
    st.sampled_from(["tanh", "relu"]),
    st.lists(st.integers(1, 9), max_size=3),
    st.booleans(),
    st.integers(1, 40),
    st.sampled_from([512, 7, 1]),
    st.booleans(),
    st.integers(0, 2**32),
)
@settings(max_examples=200, deadline=None)
def test_outputs_and_gradients_are_autograds(
    activation: Any, net: list[int], dueling: bool, rows: int, piece: int, by_torch: bool, seed: int
) -> None:
    with patch.multiple(layers, CHUNK_ROWS=piece, uses_torch=lambda _: by_torch):
        outputs_and_gradients(policy(tuple(net), activation, dueling), rows, seed)


@pytest.mark.parametrize("dueling", [False, True])
@pytest.mark.parametrize("rows", [32, 64, 129, 2048])
def test_so_they_are_at_the_sizes_that_are_used(dueling: bool, rows: int) -> None:
    outputs_and_gradients(policy((64, 64), "relu", dueling), rows, 0)
    outputs_and_gradients(policy((256, 256), "tanh", dueling), rows, 1)


@pytest.mark.parametrize("dueling", [False, True])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("loss", sorted(LOSSES))
@pytest.mark.parametrize(("piece", "by_torch"), [(512, False), (4, True)])
def test_the_gradient_is_the_slope_of_the_loss_in_float64(
    dueling: bool, activation: Any, loss: str, piece: int, by_torch: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Central differences of the loss of the values of some actions, by every parameter."""
    monkeypatch.setattr(layers, "CHUNK_ROWS", piece)
    monkeypatch.setattr(layers, "uses_torch", lambda _: by_torch)
    generator, rows = np.random.default_rng(5), 9
    spec = policy((5, 3), activation, dueling)
    flat = generator.normal(0, 0.5, sum(map(total_size, parameter_layout(spec))))
    grad = np.full_like(flat, np.nan)
    without = FusedQNetwork(spec, flat, grad)
    x, action = generator.normal(size=(rows, 4)), generator.integers(0, 4, rows)
    target, weight = 2 * generator.normal(size=rows), generator.random(rows)

    def loss_and_gradient() -> tuple[float, Array]:
        found, by_error = LOSSES[loss](without.forward(x)[action, np.arange(rows)] - target, weight)
        return float(found), by_error

    by_value = np.zeros((4, rows))
    by_value[action, np.arange(rows)] = loss_and_gradient()[1]
    without.backward(by_value)
    is_the_slope(grad, lambda: loss_and_gradient()[0], flat, 1e-7, 1e-8)


OPTIONS: list[dict[str, Any]] = [
    {},
    {"double": False, "loss": "squared"},
    {"dueling": True, "n_step": 3, "target": "polyak", "tau": 0.1},
    {"replay": "prioritized", "double": False, "max_grad_norm": 0.5},
    {"max_grad_value": 0.01, "activation": "tanh", "loss": "squared"},
    {"max_grad_value": 0.05, "max_grad_norm": 0.1, "optimizer": "adamw", "amsgrad": True},
    {"normalize_observations": True, "dueling": True, "double": False, "replay": "prioritized", "amsgrad": True},
    {"net": (), "batch_size": 700},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_updates_are_the_same_either_way(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Updates without the graph. Before each step, the one with the graph takes over the state, so errors do not add up.

    Cutting entries enlarges no error. Shortening a gradient g to the norm m multiplies it by a factor whose relative error
    is that of |g|, which is more than m.
    """
    settings = {"net": (16,), "replay_size": 1000, "learning_starts": 0, "gradient_steps": 8, "target_every": 5}
    config = msgspec.convert(settings | options, DQNConfig)
    made: list[DQN] = []
    errors: list[Array] = []
    for most in (fused.MAX_ROWS, 0):
        monkeypatch.setattr(fused, "MAX_ROWS", most)
        made.append(DQN(config, DQN.policy_spec(config, (BOX,), DISCRETE.action), total_steps=1000, seed=0))
    for each in made:
        monkeypatch.setattr(each.replay, "update_priorities", recording(each.replay.update_priorities, errors))
    one, other = made
    assert isinstance(one._values, FusedActionValues)
    assert isinstance(other._values, AutogradActionValues)
    step, steps = one.step, 0

    def both(sample: Sample) -> StepMetrics:
        nonlocal steps
        other.load_state_dict(one.state_dict())
        values = one.net.params(torch.from_numpy(one.inputs(sample.leaves)[0])).detach().numpy()
        error = values[np.arange(len(values)), sample.action] - one.targets(sample)
        tolerance, of_error = gradient_tolerance(one, sample, error), tolerance_of(error_variance(one, sample))
        found, expected = step(sample), other.step(sample)
        assert found._asdict() == pytest.approx(expected._asdict(), rel=1e-3, abs=1e-4)
        assert_within(errors[-2], errors[-1], of_error)
        gradient = other.net.flat_grad.numpy()
        if config.max_grad_norm is not None:
            of_norm = np.linalg.norm(tolerance) / config.max_grad_norm + 4 * np.sqrt(len(gradient)) * UNIT
            tolerance = tolerance + np.abs(gradient) * of_norm
        assert_within(one.net.flat_grad.numpy(), gradient, tolerance)
        steps += 1
        return found

    monkeypatch.setattr(one, "step", both)
    for seed in range(3):
        one.update(batch(seed, fresh=seed == 0), no_pulse)
    assert steps == 3 * 8
    assert not torch.equal(one.net.flat, QNetwork(one.policy, seed=0).flat)


def recording(update_priorities: Callable[[Array, Array], None], errors: list[Array]) -> Callable[[Array, Array], None]:
    def recorded(slots: Array, error: Array) -> None:
        errors.append(error.copy())
        update_priorities(slots, error)

    return recorded


def test_every_step_has_the_same_gradient_either_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two copies of the same values, one with the graph and one without, on the same minibatches.

    The one with the graph takes the weights of the other before each step, so errors do not add up.
    """
    config = DQNConfig(target_every=50, replay_size=100, double=False, max_grad_norm=None)
    spec = DQN.policy_spec(config, (BOX,), DISCRETE.action)
    one = DQN(config, spec, total_steps=1, seed=0)
    monkeypatch.setattr(fused, "MAX_ROWS", 0)
    other = DQN(config, spec, total_steps=1, seed=0)
    generator = np.random.default_rng(0)
    for _ in range(200):
        x = generator.normal(size=(2, 64, 4)).astype(np.float32)
        sample = Sample(
            slots=np.arange(64),
            leaves=(x[0],),
            action=generator.integers(0, 4, 64),
            reward=np.tanh(x[0].sum(-1)),
            discount=np.full(64, 0.9, np.float32),
            next_leaves=(x[1],),
            weight=np.ones(64, np.float32),
        )
        other.net.flat.copy_(one.net.flat)
        other.target.flat.copy_(one.target.flat)
        chosen = one.net.params(torch.from_numpy(x[0])).detach().numpy()[np.arange(64), sample.action]
        tolerance = gradient_tolerance(one, sample, chosen - one.targets(sample))
        first, second = one.step(sample), other.step(sample)
        assert_within(one.net.flat_grad.numpy(), other.net.flat_grad.numpy(), tolerance)
        assert first._asdict() == pytest.approx(second._asdict(), rel=1e-3, abs=1e-4)


@pytest.mark.parametrize(
    ("spec", "rows", "expected"),
    [
        (policy((16,)), 64, FusedActionValues),
        (policy((16,), dueling=True), fused.MAX_ROWS, FusedActionValues),
        (policy((16,)), fused.MAX_ROWS + 1, AutogradActionValues),
        (policy((fused.MAX_UNITS + 1,)), 64, AutogradActionValues),
        (msgspec.structs.replace(IMAGE, head="q"), 64, AutogradActionValues),
    ],
)
def test_it_is_chosen_by_the_policy_and_the_minibatch(spec: PolicySpec, rows: int, expected: type) -> None:
    assert type(action_values(QNetwork(spec), rows)) is expected
