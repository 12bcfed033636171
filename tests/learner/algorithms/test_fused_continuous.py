"""The passes of SAC's and TD3's networks without a graph are those with one, in float64; and when they are chosen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.algorithms.kernels import fused
from learner.algorithms.kernels.actor_and_critics import ActorAndCriticsPasses, AutogradPasses, FusedPasses, passes_of
from learner.algorithms.kernels.bounded_actions import DeterministicAction, SquashedSample, smaller, which_is_smaller
from protocol.arrays import Array
from protocol.policy.networks import ActorAndCritics
from protocol.policy.torch_distributions import squashed_sample
from protocol.specs import ActionSpec, Leaf, PolicySpec
from tests.support.finite_differences import is_the_slope

FEATURES, ACTIONS = 5, 2
POLICY = PolicySpec(
    (Leaf("", "box", (FEATURES,), "float32"),),
    ActionSpec("box", (ACTIONS,), "float32", low=(-1.0,) * ACTIONS, high=(1.0,) * ACTIONS),
    net=(16, 8),
    activation="relu",
    head="squashed",
)
RELATIVE = 1e-9  # float64 has 1e-16; a few thousand additions, and gradients that cancel


@pytest.fixture(autouse=True)
def _float64() -> Iterator[None]:
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(dtype)


def networks(seed: int, scale: float, **changes: Any) -> list[ActorAndCritics]:
    """Twice the same network, with random weights."""
    made = [ActorAndCritics(msgspec.structs.replace(POLICY, **changes)) for _ in range(2)]
    weights = torch.from_numpy(np.random.default_rng(seed).normal(0, scale, len(made[0].flat)))
    for net in made:
        net.flat.copy_(weights)
        net.flat_grad.fill_(7.0)  # a backward pass writes: it does not add
    return made


def everything(passes: ActorAndCriticsPasses, net: ActorAndCritics, rows: int, seed: int) -> list[Array]:
    """All outputs and gradients for random rows; the gradient of the actor is that of random numbers."""
    generator = np.random.default_rng(seed)

    def normal(*shape: int) -> Any:
        return passes.to_array(generator.normal(size=shape))

    x, action, by_values = normal(rows, FEATURES), normal(rows, ACTIONS), normal(2, rows)
    by_actor = normal(rows, ACTIONS * (2 if net.spec.head == "squashed" else 1))
    found = [passes.to_numpy(passes.values(x, action)).copy()]
    passes.critics_backward(by_values)
    found.append(net.critics.grad.numpy().copy())  # type: ignore[union-attr]
    for critics in (1, 2):
        found.append(passes.to_numpy(passes.values_by_action(x, action, critics)).copy())
        np.testing.assert_array_equal(len(found[-1]), critics)
        found.append(passes.to_numpy(passes.action_gradient(by_values[:critics])).copy())
    np.testing.assert_array_equal(net.critics.grad, found[1])  # the gradient by the actions leaves that of the weights
    found.append(passes.to_numpy(passes.params(x)).copy())
    passes.actor_backward(by_actor)
    return [*found, net.actor.grad.numpy().copy()]  # type: ignore[union-attr]


@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=3),
    st.sampled_from(["relu", "tanh"]),
    st.sampled_from(["squashed", "deterministic"]),
    st.integers(1, 1100),
    st.integers(0, 999),
)
@settings(max_examples=30, deadline=None)
def test_passes_in_numpy_are_those_of_autograd(net: list[int], activation: str, head: str, rows: int, seed: int) -> None:
    """Weights are large, so that the logarithms of many standard deviations leave their bounds."""
    ours, reference = networks(seed, 1.5, net=tuple(net), activation=activation, head=head)
    found = everything(FusedPasses(ours), ours, rows, seed)
    expected = everything(AutogradPasses(reference), reference, rows, seed)
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=RELATIVE, atol=RELATIVE * abs(theirs).max())


def test_standard_deviations_outside_their_bounds_get_no_gradient() -> None:
    net, _ = networks(0, 0.0)
    net.parameters["actor.out.bias"].data[:] = torch.tensor([0.0, 0.0, 3.0, 1.0])
    passes = FusedPasses(net)
    assert passes.params(np.zeros((1, FEATURES))).tolist() == [[0, 0, 2, 1]]
    passes.actor_backward(np.ones((1, 4)))
    assert net.parameters["actor.out.bias"].grad.tolist() == [1, 1, 0, 1]  # type: ignore[union-attr]


def test_a_squashed_sample_is_that_of_torch_and_its_gradients_are_slopes() -> None:
    generator = np.random.default_rng(0)
    params, noise = generator.normal(0, 1.5, (40, 2 * ACTIONS)), generator.normal(size=(40, ACTIONS))
    by_action, by_log_prob = generator.normal(size=(40, ACTIONS)), 0.3
    sample = SquashedSample(params, noise)
    tensors = torch.from_numpy(params).requires_grad_()
    action, log_prob = squashed_sample(tensors, torch.from_numpy(noise))
    np.testing.assert_allclose(sample.action, action.detach(), rtol=RELATIVE)
    np.testing.assert_allclose(sample.log_prob, log_prob.detach(), rtol=RELATIVE)
    loss = (action * torch.from_numpy(by_action)).sum() + by_log_prob * log_prob.sum()
    (expected,) = torch.autograd.grad(loss, tensors)
    found = sample.backward(by_action, by_log_prob)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)

    def lost() -> float:
        at = SquashedSample(params, noise)
        return float((at.action * by_action).sum() + by_log_prob * at.log_prob.sum())

    is_the_slope(found.ravel(), lost, params.ravel(), 1e-6)


def test_a_squashed_sample_far_outside_is_finite() -> None:
    sample = SquashedSample(np.array([[400.0, 0.0]]), np.array([[1.0]]))
    assert sample.action == 1
    assert sample.log_prob[0] == pytest.approx(-0.5 - 0.5 * np.log(2 * np.pi) - 2 * (np.log(2) - 401))
    assert np.isfinite(sample.backward(np.ones((1, 1)), 0.1)).all()


def test_a_deterministic_action_and_its_gradient() -> None:
    chosen = DeterministicAction(np.array([[0.5, -2.0]]))
    np.testing.assert_allclose(chosen.action, np.tanh([[0.5, -2.0]]))
    np.testing.assert_allclose(chosen.backward(np.array([[1.0, 3.0]])), [[1, 3]] / np.cosh([[0.5, -2.0]]) ** 2)


@pytest.mark.parametrize("library", [np.array, torch.tensor])
def test_the_smaller_value_of_each_row(library: Any) -> None:
    values = library([[1.0, 5.0, 2.0], [3.0, 4.0, 2.0]])
    assert smaller(values).tolist() == [1, 4, 2]
    assert which_is_smaller(values).tolist() == [[True, False, True], [False, True, False]]


@pytest.mark.parametrize(
    ("net", "rows", "expected"),
    [
        ((16,), fused.MAX_ROWS, FusedPasses),
        ((16,), fused.MAX_ROWS + 1, AutogradPasses),
        ((fused.MAX_UNITS + 1,), 64, AutogradPasses),
        ((), 64, AutogradPasses),
    ],
)
def test_small_networks_use_numpy(net: tuple[int, ...], rows: int, expected: type) -> None:
    assert type(passes_of(ActorAndCritics(msgspec.structs.replace(POLICY, net=net)), rows)) is expected
