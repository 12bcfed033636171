"""PPO's update: its minibatches, its schedules, its gradient, what it learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from millrace.learner.algorithms.actor_critic import Estimates, Pulse
from millrace.learner.algorithms.minibatches import Minibatch, Observations
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.config.hyperparameters import PPOConfig
from millrace.protocol.arrays import Floats
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec
from tests.support.numbers.batches import (
    DISCRETE,
    GAUSSIAN,
    batch,
    no_pulse,
    normal,
)
from tests.support.numbers.rounding import ELEMENTWISE, UNIT, assert_within
from tests.support.numbers.steps import Errors, gradient_tolerance, usual_rows, watched


def ppo(config: PPOConfig | None = None, spec: PolicySpec = DISCRETE, seed: int = 0) -> PPO:
    return PPO(config or PPOConfig(), spec, total_steps=10_000, seed=seed)


@pytest.mark.parametrize("spec", [normal(DISCRETE), normal(GAUSSIAN)])
def test_losses_see_observations_as_the_worker_did(spec: PolicySpec) -> None:
    """The statistics change between versions, never between acting and learning: the first ratio is 1."""
    algorithm = ppo(PPOConfig(n_epochs=1, batch_size=10_000), spec)
    for seed in range(2):
        metrics = algorithm.update(batch(algorithm, seed), no_pulse)
        assert abs(metrics["train/approx_kl"]) < 1e-6
        assert metrics["train/clip_fraction"] == 0
    assert algorithm.weights()[1][:4] == pytest.approx([2] * 4, abs=1)
    assert algorithm.weights()[1][4:] == pytest.approx([3] * 4, abs=1)


def test_minibatches_hold_each_valid_row_once_an_epoch_in_nearly_equal_parts() -> None:
    algorithm = ppo(PPOConfig(batch_size=25, n_epochs=2))
    seen = watched(algorithm)
    rows = batch(algorithm, 0)
    pulses: list[int] = []
    algorithm.update(rows, lambda: pulses.append(1))
    count = int(rows.valid.sum())
    parts = -(-count // 25)
    assert len(seen) == 2 * parts
    assert len(pulses) >= 2 * parts
    assert {len(each.target) for each in seen} <= {count // parts, count // parts + 1}
    expected = sorted(map(tuple, rows.obs[0][:-1][rows.valid].tolist()))
    epochs = [np.concatenate([each.features for each in seen[at : at + parts]]).tolist() for at in (0, parts)]
    assert epochs[0] != epochs[1]
    for epoch in epochs:
        assert sorted(map(tuple, epoch)) == expected


def test_target_kl_stops_before_the_step_that_would_go_on() -> None:
    free, held = (ppo(PPOConfig(learning_rate=0.05, n_epochs=5, batch_size=16, target_kl=limit)) for limit in (None, 1e-4))
    start = held.net.flat.clone()
    pulses: list[int] = []
    free_metrics = free.update(batch(free, 0), no_pulse)
    held_metrics = held.update(batch(held, 0), lambda: pulses.append(1))
    assert free_metrics["train/n_updates"] == 5
    assert held_metrics["train/n_updates"] == 1
    assert int(held.state_dict()["optimizer"]["state"][0]["step"]) == 1  # the second minibatch saw how far the first went
    assert len(pulses) == 3  # after all values, and after these two minibatches
    assert not torch.equal(held.net.flat, start)


def test_an_update_whose_estimate_uses_no_row_changes_no_weight() -> None:
    class UsesNone(PPO):
        def estimate(self, batch: Batch, observations: Observations, reward: Floats, pulse: Pulse) -> Estimates:
            return super().estimate(batch, observations, reward, pulse)._replace(used=np.zeros_like(batch.valid))

    algorithm = UsesNone(PPOConfig(), DISCRETE, total_steps=10_000, seed=0)
    before = algorithm.net.flat.clone()
    metrics = algorithm.update(batch(algorithm, 0), no_pulse)
    assert torch.equal(algorithm.net.flat, before)
    assert "train/loss" not in metrics
    assert algorithm.version == 1


@pytest.mark.parametrize("spec", [DISCRETE, GAUSSIAN])
def test_metrics_have_the_names_of_stable_baselines(spec: PolicySpec) -> None:
    algorithm = ppo(PPOConfig(ent_coef=0.1, batch_size=1000, n_epochs=1), spec)
    metrics = algorithm.update(batch(algorithm, 0), no_pulse)
    names = "approx_kl clip_fraction entropy_loss explained_variance value_loss policy_gradient_loss loss learning_rate "
    names += "clip_range n_updates" + (" std" if spec is GAUSSIAN else "")
    assert {f"train/{name}" for name in names.split()} <= set(metrics)
    parts = (metrics[f"train/{name}"] for name in ("policy_gradient_loss", "value_loss", "entropy_loss"))
    policy, value, entropy = parts
    assert metrics["train/loss"] == pytest.approx(policy + 0.5 * value + 0.1 * entropy)
    if spec is DISCRETE:
        assert entropy == pytest.approx(-np.log(4), abs=1e-2)
    else:
        assert metrics["train/std"] == pytest.approx(1, abs=1e-2)


@pytest.mark.parametrize("spec", [DISCRETE, GAUSSIAN])
def test_a_step_follows_the_gradient_of_the_usual_loss(spec: PolicySpec) -> None:
    algorithm = ppo(PPOConfig(vf_coef=0.7, ent_coef=0.3, max_grad_norm=1e9, clip_range=0.1), spec)
    x, action, advantage, target, usual, value = usual_rows(algorithm)
    log_prob = usual.log_prob(action)
    old = log_prob.detach() + 0.2 * torch.randn(30, generator=torch.Generator().manual_seed(1))
    ratio = (log_prob - old).exp()
    a = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    policy_loss = -torch.min(ratio * a, ratio.clamp(0.9, 1.1) * a).mean()
    (policy_loss + 0.7 * (value - target).square().mean() - 0.3 * usual.entropy().mean()).backward()
    expected = algorithm.net.flat_grad.clone()
    rows = Minibatch(x, (), action, old, advantage, target)
    allowed = gradient_tolerance(algorithm, rows)
    measured, _ = algorithm.step(rows)
    assert_within(algorithm.net.flat_grad.numpy(), expected.numpy(), allowed)
    assert measured["clip_fraction"] > 0
    assert measured["policy_gradient_loss"] == pytest.approx(policy_loss.item(), rel=1e-4)


def test_clipped_values_move_less() -> None:
    """With a step size that moves them far in an epoch, and nothing else to learn."""
    moved = []
    for limit in (None, 0.05):
        config = PPOConfig(
            clip_range_vf=limit, learning_rate=0.01, n_epochs=10, batch_size=1000, ent_coef=0.0, max_grad_norm=1e9
        )
        algorithm = ppo(config)
        rows = batch(algorithm, 0)
        seen = algorithm.observations(rows)
        before = algorithm.values(seen, no_pulse)
        algorithm.update(rows, no_pulse)
        moved.append(float(np.abs(algorithm.values(seen, no_pulse) - before)[:-1][rows.valid].mean()))
    assert moved[0] > 0.4
    assert moved[1] < 0.6 * moved[0]


@pytest.mark.parametrize("before", [-3.0, 0.0, 0.7, 5.0])
def test_a_step_with_clipped_values_follows_the_gradient_of_the_usual_loss(before: float) -> None:
    """The value before the update is the target less the advantage, which is standardised only afterwards."""
    algorithm = ppo(PPOConfig(vf_coef=1.0, max_grad_norm=1e9, clip_range_vf=0.5))
    x, action, _, target, _, value = usual_rows(algorithm)
    old = torch.full((30,), before)
    clipped = old + (value - old).clamp(-0.5, 0.5)
    loss = torch.maximum((value - target).square(), (clipped - target).square()).mean()
    loss.backward()  # type: ignore[no-untyped-call]
    critic = slice(algorithm.net.acting_size, None)
    expected = algorithm.net.flat_grad.clone()
    rows = Minibatch(x, (), action, torch.zeros(30), target - old, target)
    allowed = gradient_tolerance(algorithm, rows, Errors(target=ELEMENTWISE * UNIT * abs(before)))  # it is rounded
    algorithm.step(rows)
    assert_within(algorithm.net.flat_grad[critic].numpy(), expected[critic].numpy(), allowed[critic])
