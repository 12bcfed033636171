"""TQC, CrossQ and XQC: workers act as the networks do in evaluation, by the newest weights and statistics, also later."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.protocol.arrays import Array
from millrace.protocol.policy.layout import LOG_STD_BOUNDS
from millrace.protocol.policy.numpy_policy import NumpyPolicy
from millrace.protocol.policy.torch_policy import TorchPolicy
from tests.learner.algorithms.bodies import plain_formula as plain
from tests.learner.algorithms.test_continuous import batch, made, no_pulse
from tests.support.variants import variants

SETTINGS: dict[str, dict[str, Any]] = {
    "tqc": {"updates_per_step": 0.3},
    "crossq": {"updates_per_step": 0.3, "critic_net": (16, 16), "renormalize_after": 9, "policy_delay": 2},
    "xqc": {"updates_per_step": 0.3, "critic_net": (16, 16), "policy_delay": 2, "atoms": 11},
}
ALL = pytest.mark.parametrize("algo", list(SETTINGS))
NORMALIZED = pytest.mark.parametrize("algo", ["crossq", "xqc"])
ROUNDING = 2.0**-24
"""of an operation in float32, relative"""


def learned(algo: str, updates: int = 2) -> Any:
    """An algorithm after some updates, so that its statistics are not those it began with."""
    algorithm = made(algo, **SETTINGS[algo])
    for seed in range(updates):
        algorithm.update(batch(seed), no_pulse)
    return algorithm


def observations() -> Array:
    return np.random.default_rng(0).normal(0, 3, (1, 50, 3)).astype(np.float32)


def statistics_of_actor(algorithm: Any) -> Tensor:
    net = algorithm.net
    size = sum(2 * size for size in net.actor_body.shape.sizes[:-1]) if net.statistics.numel() else 0
    found: Tensor = net.statistics[:size].double()
    return found


def in_float64(algorithm: Any, obs: Array) -> tuple[Tensor, Tensor]:
    """The actor's outputs [B, 2 D′] by the plain formula in float64, and how far float32 may be off.

    A sum of n products is off by at most n roundings of the sum of their sizes; so is each layer by n + 10 for its
    normalization, which is folded into it. Errors of earlier layers pass through the later ones, which lets them grow by no
    more than the sizes of the weights. So the error is at most all these roundings times what the formula gives if each
    number in it is replaced by its size.
    """
    net, x = algorithm.net, torch.from_numpy(obs[0]).double()
    shape, flat, running = net.actor_body.shape, net.actor.double(), statistics_of_actor(algorithm)

    def sizes(h: Tensor, layer: plain.PlainLayer, of: plain.Statistics) -> Tensor:
        return layer.gain * (h + of.mean.abs()) / (of.variance + plain.EPS).sqrt() + layer.shift

    (outputs,) = plain.outputs(shape, flat, x, plain.evaluated, running)
    (largest,) = plain.outputs(shape._replace(relu=True), flat.abs(), x.abs(), sizes, running)
    outputs[:, 2:].clamp_(-20, 2)
    return outputs, sum(size + 10 for size in shape.sizes[:-1]) * ROUNDING * largest


@ALL
@pytest.mark.parametrize("kind", [NumpyPolicy, TorchPolicy])
def test_workers_act_as_the_networks_do_in_evaluation(algo: str, kind: Any) -> None:
    algorithm, obs = learned(algo), observations()
    expected, error = in_float64(algorithm, obs)
    assert (error < 1e-3).all(), "the bound says something"
    policy = kind(algorithm.policy)
    policy.load(*algorithm.weights())
    found = torch.from_numpy(policy([obs])[0, :, :4]).double()
    assert ((found - expected).abs() <= error).all()


@ALL
def test_the_learner_evaluates_its_networks_as_workers_act(algo: str) -> None:
    algorithm, obs = learned(algo), observations()
    expected, error = in_float64(algorithm, obs)
    with torch.no_grad():
        found = algorithm.net.params(torch.from_numpy(obs[0])).double()
    assert ((found - expected).abs() <= error).all()


@ALL
@pytest.mark.parametrize("trains", [True, False])
def test_logarithms_of_standard_deviations_have_bounds(algo: str, trains: bool) -> None:
    algorithm = learned(algo, updates=0)
    (layers,) = plain.layers(algorithm.net.actor_body.shape, algorithm.net.actor)
    layers[-1].bias[2:] = torch.tensor([50.0, -50.0])
    with torch.set_grad_enabled(trains):
        found = algorithm.net.params(torch.from_numpy(observations()[0]))
    assert (found[:, 2:].detach() == torch.tensor(LOG_STD_BOUNDS).flip(0)).all()


@ALL
def test_weights_that_were_published_stay_those_of_their_version(algo: str) -> None:
    algorithm = learned(algo)
    published = algorithm.weights()[0]
    before = published.copy()
    algorithm.update(batch(5), no_pulse)
    assert np.array_equal(published, before)
    assert not np.array_equal(algorithm.weights()[0], before)


@NORMALIZED
def test_statistics_alone_that_move_are_other_weights(algo: str) -> None:
    algorithm = learned(algo)
    before = algorithm.weights()[0]
    with torch.enable_grad():
        algorithm.net.params(torch.randn(32, 3, generator=torch.Generator().manual_seed(0)))
    assert not np.array_equal(algorithm.weights()[0], before)


@ALL
def test_a_saved_state_publishes_the_same_weights_and_learns_on_with_the_same_bits(algo: str) -> None:
    algorithm = learned(algo)
    file = io.BytesIO()
    torch.save(algorithm.state_dict(), file)
    file.seek(0)
    other = made(algo, seed=7, **SETTINGS[algo])
    other.load_state_dict(torch.load(file, weights_only=True))
    for seed in (3, 4):
        assert first_difference(algorithm.weights(), other.weights()) is None
        for each in (algorithm, other):
            each.update(batch(seed), no_pulse)
    assert first_difference(algorithm.state_dict(), other.state_dict()) is None


@pytest.mark.parametrize("algo", variants(["crossq", "xqc"], default=["xqc"]))
def test_a_step_that_is_rolled_back_leaves_the_statistics_as_they_were(algo: str) -> None:
    algorithm = learned(algo)
    before = algorithm.net.statistics.clone()
    algorithm.remember()
    algorithm.update(batch(5), no_pulse)
    assert not torch.equal(algorithm.net.statistics, before)
    algorithm.roll_back()
    assert torch.equal(algorithm.net.statistics, before)
