"""What the actor-critics have in common: schedules, metrics, optimizers, steps of the usual loss."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor

from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.learner.algorithms import Algorithm, algorithm_class
from millrace.learner.algorithms.actor_critic import ActorCritic
from millrace.learner.algorithms.minibatches import LossInput, Minibatch
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.config.hyperparameters import HYPERPARAMETERS, PPOConfig
from millrace.protocol.errors import RunError
from millrace.protocol.policy.layout import acting_size
from millrace.protocol.specs import PolicySpec
from tests.support.numbers.batches import (
    COPIES,
    DISCRETE,
    GAUSSIAN,
    LANES,
    MIXED,
    T,
    batch,
    identity_batch,
    no_pulse,
    normal,
    shared,
)
from tests.support.numbers.rounding import ELEMENTWISE, SAMPLES, UNIT, assert_within, tolerance_of
from tests.support.numbers.steps import gradient_tolerance, usual_rows, watched

NAMES = ["a2c", "impala", "reinforce"]


def make(name: str, spec: PolicySpec = DISCRETE, seed: int = 0, **settings: Any) -> ActorCritic:
    config = msgspec.convert(settings, HYPERPARAMETERS[name])
    algorithm: Any = algorithm_class(name)(config, spec, total_steps=10_000, seed=seed)
    assert isinstance(algorithm, ActorCritic)
    return algorithm


@pytest.mark.parametrize("name", ["ppo", *NAMES])
def test_each_is_an_algorithm_with_the_policy_of_its_settings(name: str) -> None:
    config = msgspec.convert({"shared_net": True, "net": [8], "normalize_observations": True}, HYPERPARAMETERS[name])
    spec = algorithm_class(name).policy_spec(config, DISCRETE.observation, DISCRETE.action)
    assert (spec.shared_net, spec.net, spec.normalize_observations) == (True, (8,), True)
    algorithm: Algorithm = algorithm_class(name)(config, spec, total_steps=1, seed=0)
    assert algorithm.weights()[0].shape == (acting_size(spec),)
    assert algorithm.weights()[1].tolist() == [0.0] * 4 + [1.0] * 4  # means and standard deviations


@pytest.mark.parametrize("name", ["ppo", *NAMES])
def test_a_batch_without_a_valid_row_changes_nothing(name: str) -> None:
    a, b = make(name), make(name)
    empty = msgspec.structs.replace(batch(a, 0), valid=np.zeros((T, LANES * COPIES), bool))
    assert a.update(empty, no_pulse) == {}
    assert first_difference(a.state_dict(), b.state_dict()) is None


@pytest.mark.parametrize(("name", "settings"), [("ppo", {"batch_size": 1}), ("impala", {"minibatches": 1000})])
def test_a_minibatch_of_one_row_is_learned_from(name: str, settings: dict[str, Any]) -> None:
    algorithm = make(name, **settings)
    seen = watched(algorithm)
    metrics = algorithm.update(batch(algorithm, 0, steps=2), no_pulse)
    assert {len(each.features) for each in seen} == {1}
    assert np.isfinite(algorithm.weights()[0]).all()
    assert np.isfinite(metrics["train/value_loss"])


@pytest.mark.parametrize("name", ["ppo", *NAMES])
def test_schedules_follow_the_steps_used(name: str) -> None:
    schedules: dict[str, Any] = {"learning_rate_schedule": "linear"} | (
        {"clip_range_schedule": "linear"} if name == "ppo" else {}
    )
    algorithm, used = make(name, learning_rate=0.01, **schedules), 0
    for seed in range(3):
        left = 1 - used / 10_000
        rows = batch(algorithm, seed)
        metrics = algorithm.update(rows, no_pulse)
        assert metrics["train/learning_rate"] == pytest.approx(0.01 * left)
        if name == "ppo":
            assert metrics["train/clip_range"] == pytest.approx(0.2 * left)
        assert algorithm.version == seed + 1
        used += int(rows.valid.sum())
    assert 0 < left < 1


@pytest.mark.parametrize("name", ["ppo", *NAMES])
def test_the_entropy_coefficient_follows_its_schedule_in_the_loss(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = make(name, ent_coef=3.0, ent_coef_schedule="linear")
    loss_of = algorithm.loss
    weights: list[float] = []

    def loss(rows: LossInput) -> tuple[Tensor, Mapping[str, Tensor | float]]:
        total, numbers = loss_of(rows)
        rest = total - numbers["policy_gradient_loss"] - algorithm.vf_coef * numbers["value_loss"]
        weights.append((rest / numbers["entropy_loss"]).item())
        return total, numbers

    monkeypatch.setattr(algorithm, "loss", loss)
    for seed in range(2):
        left = 1 - algorithm.env_steps / 10_000
        metrics = algorithm.update(batch(algorithm, seed), no_pulse)
        assert metrics["train/ent_coef"] == pytest.approx(3 * left)
        assert weights == pytest.approx([3 * left] * len(weights), rel=1e-3)
        weights.clear()
    assert left < 1
    algorithm = make(name, ent_coef=3.0)
    assert "train/ent_coef" not in algorithm.update(batch(algorithm, 0), no_pulse)
    assert algorithm.ent_coef == 3


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("spec", [DISCRETE, GAUSSIAN])
def test_metrics_have_the_names_of_stable_baselines(name: str, spec: PolicySpec) -> None:
    algorithm = make(name, spec)
    metrics = algorithm.update(batch(algorithm, 0), no_pulse)
    names = "entropy_loss explained_variance value_loss policy_gradient_loss learning_rate n_updates grad_norm"
    assert {f"train/{each}" for each in names.split()} <= set(metrics)
    assert ("train/std" in metrics) == (spec is GAUSSIAN)
    assert all(map(np.isfinite, metrics.values()))


@pytest.mark.parametrize(("log_std", "refused"), [(79.0, False), (81.0, True)])
def test_a_spread_of_actions_that_no_rollout_can_hold_is_named(log_std: float, refused: bool) -> None:
    """With an entropy bonus it may grow for ever: the bounds of the Box hide it from the environment."""
    algorithm = make("a2c", GAUSSIAN, learning_rate=1e-3)
    rows = batch(algorithm, 0)
    algorithm.net.parameters["actor.log_std"].detach().fill_(log_std)
    if not refused:
        algorithm.update(rows, no_pulse)
        return
    expected = "update 0: logarithm of the standard deviation of actions: expected at most 80, got 81; try a lower ent_coef"
    with pytest.raises(RunError, match=expected):
        algorithm.update(rows, no_pulse)


@pytest.mark.parametrize("spec", [DISCRETE, GAUSSIAN, shared(DISCRETE), shared(GAUSSIAN)])
@pytest.mark.parametrize("critic", [True, False])
def test_a_step_follows_the_gradient_of_the_usual_loss(spec: PolicySpec, critic: bool) -> None:
    algorithm = make("a2c", spec, vf_coef=0.7 if critic else 0.0, ent_coef=0.3, max_grad_norm=1e9)
    x, action, advantage, target, usual, value = usual_rows(algorithm)
    policy_loss = -(usual.log_prob(action) * advantage).mean()
    value_loss = (value - target).square().mean() if critic else torch.zeros(())
    (policy_loss + 0.7 * value_loss - 0.3 * usual.entropy().mean()).backward()
    expected = algorithm.net.flat_grad.clone()
    rows = Minibatch(x, (), action, advantage, advantage, target)
    allowed = gradient_tolerance(algorithm, rows)
    measured, _ = algorithm.step(rows)
    assert_within(algorithm.net.flat_grad.numpy(), expected.numpy(), allowed)
    assert measured["policy_gradient_loss"] == pytest.approx(policy_loss.item(), rel=1e-4)


def test_a_loss_of_ones_own_is_the_one_that_trains() -> None:
    class OtherLoss(PPO):
        def loss(self, rows: LossInput) -> Any:
            return rows.value.square().mean(), {"penalty": 0.25, "value": rows.value.mean()}

    own = OtherLoss(PPOConfig(), DISCRETE, total_steps=1, seed=0)
    before = own.net.flat.clone()
    x, zeros = torch.randn((30, 4), generator=torch.Generator().manual_seed(0)), torch.zeros(30)
    value = own.net.value(x).detach()
    measured, _ = own.step(Minibatch(x, (), zeros.long(), zeros, zeros, zeros))
    assert measured["penalty"] == 0.25
    assert measured["value"] == value.mean().item()
    acting = own.net.acting_size
    assert torch.equal(own.net.flat[:acting], before[:acting])
    assert own.net.value(x).square().mean() < value.square().mean()


@pytest.mark.parametrize("optimizer", ["rmsprop", "adam"])
def test_the_optimizers_are_torchs_on_each_array_of_the_network(optimizer: str) -> None:
    """RMSProp with ε 1e-5 outside the square root and α 0.99, as Stable-Baselines3's A2C has it; gradients cut to 0.5.

    Torch's optimizer has float64 parameters [1 + SAMPLES, P]. All rows but the first get noise: that of rounded gradients,
    and that of a rounded step. The deviations from the first row give the tolerance.
    """
    algorithm = make("a2c", optimizer=optimizer, learning_rate=0.02, max_grad_norm=0.5)
    algorithm.set_schedules()
    parameters = list(algorithm.net.parameters.values())
    usual = algorithm.net.flat.double().repeat(1 + SAMPLES, 1)
    reference: Any = (
        torch.optim.RMSprop([usual], lr=0.02, alpha=0.99, eps=1e-5)
        if optimizer == "rmsprop"
        else torch.optim.Adam([usual], lr=0.02, eps=1e-5)
    )
    generator = torch.Generator().manual_seed(0)

    def noise() -> Tensor:
        found = torch.randn(usual.shape, generator=generator)
        found[0] = 0
        return found

    for _ in range(5):
        x, advantage, target = (torch.randn(s, generator=generator) for s in [(30, 4), (30,), (30,)])
        rows = Minibatch(x, (), torch.randint(4, (30,), generator=generator), advantage, 3 * advantage, target)
        now = algorithm.evaluate(rows)
        loss = -(now.log_prob_now * rows.advantage).mean() + 0.5 * (now.value - target).square().mean()
        algorithm.net.flat_grad.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        gradient = algorithm.net.flat_grad.double()
        allowed = torch.from_numpy(gradient_tolerance(algorithm, rows) / tolerance_of(np.ones(())))
        usual.grad = gradient + (allowed + ELEMENTWISE * UNIT * gradient.abs()) * noise()
        usual.grad *= 0.5 / usual.grad.norm(dim=1, keepdim=True)
        assert gradient.norm() > 0.5
        algorithm.step(rows)
        before = usual.clone()
        reference.step()
        usual += UNIT * (usual.abs() + ELEMENTWISE * (usual - before).abs()) * noise()
        tolerance = tolerance_of((usual[1:] - usual[0]).square().mean(0).numpy())
        found = torch.cat([array.detach().flatten() for array in parameters])
        assert_within(found.numpy(), usual[0].numpy(), tolerance)
        assert np.median(tolerance) < 1e-3 * 0.02  # a thousandth of a step of Adam


LEARNS: dict[str, dict[str, Any]] = {name: {"learning_rate": 0.02, "optimizer": "adam"} for name in NAMES}
LEARNS["ppo"] = {"learning_rate": 0.01, "n_epochs": 5}


@pytest.mark.parametrize("name", LEARNS)
@pytest.mark.parametrize(
    ("spec", "start", "goal"),
    [
        (normal(DISCRETE), 0.5, 0.95),
        (normal(MIXED), -1.0, 0.4),
        pytest.param(shared(DISCRETE), 0.5, 0.95, marks=pytest.mark.rest),
        pytest.param(normal(GAUSSIAN), -1.5, -0.45, marks=pytest.mark.rest),
    ],
)
def test_it_learns_the_identity(name: str, spec: PolicySpec, start: float, goal: float) -> None:
    algorithm = make(name, spec, gamma=0.9, **LEARNS[name])
    generator = np.random.default_rng(0)
    scores = []
    for _ in range(40 if name == "ppo" else 150):
        rows, score = identity_batch(algorithm, generator)
        scores.append(score)
        algorithm.update(rows, no_pulse)
    assert scores[0] < start
    assert np.mean(scores[-3:]) > (-0.35 if (name, goal) == ("ppo", -0.45) else goal)
