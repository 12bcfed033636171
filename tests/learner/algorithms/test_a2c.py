"""A2C: one step on each batch, whose gradient is that of its neighbours where they should agree."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from millrace.learner.algorithms.a2c import A2C
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.algorithms.reinforce import REINFORCE
from millrace.learner.algorithms.returns import EpisodeEnds, gae
from millrace.learner.config.hyperparameters import A2CConfig, PPOConfig, REINFORCEConfig
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec
from tests.learner.algorithms.test_returns import Rows, gae_tolerance
from tests.support.numbers.batches import DISCRETE, GAUSSIAN, batch, no_pulse, normal, shared
from tests.support.numbers.steps import Errors, only_step, watched

FREE: dict[str, Any] = {"max_grad_norm": 1e9, "gamma": 0.9, "ent_coef": 0.01, "normalize_rewards": False}


def a2c(spec: PolicySpec = DISCRETE, **settings: Any) -> A2C:
    return A2C(A2CConfig(**settings), spec, total_steps=10_000, seed=0)


def ppo(spec: PolicySpec, **settings: Any) -> PPO:
    return PPO(PPOConfig(n_epochs=1, batch_size=10_000, **settings), spec, total_steps=10_000, seed=0)


def reinforce(**settings: Any) -> REINFORCE:
    return REINFORCE(REINFORCEConfig(**settings), DISCRETE, total_steps=10_000, seed=0)


def whole(rows: Batch) -> Batch:
    """The same rows, all episodes of which terminate within the rollout."""
    terminated = rows.terminated | rows.truncated
    terminated[-1] |= rows.valid[-1]
    return msgspec.structs.replace(rows, terminated=terminated, truncated=np.zeros_like(terminated))


def test_an_update_is_one_step_on_all_valid_rows() -> None:
    algorithm = a2c(gamma=0.9, gae_lambda=0.7)
    rows = batch(algorithm, 0)
    values = algorithm.values(algorithm.observations(rows), no_pulse)
    expected = gae(rows.reward, values, EpisodeEnds.of(rows), 0.9, 0.7)
    assert algorithm.vf_coef > 0
    minibatches = watched(algorithm)
    algorithm.update(rows, no_pulse)
    (only,) = minibatches
    np.testing.assert_array_equal(only.features, rows.obs[0][:-1][rows.valid])
    np.testing.assert_array_equal(only.action, rows.action[rows.valid])
    np.testing.assert_array_equal(only.advantage, expected[rows.valid])
    np.testing.assert_array_equal(only.target, (expected + values[:-1])[rows.valid])


@pytest.mark.parametrize("spec", [DISCRETE, normal(GAUSSIAN), shared(DISCRETE)])
@pytest.mark.parametrize("normalize", [True, False])
def test_its_gradient_is_that_of_ppos_first_minibatch(spec: PolicySpec, normalize: bool) -> None:
    """Where the policy has not moved, the clipped surrogate is the policy gradient."""
    settings = FREE | {"gae_lambda": 0.8, "normalize_advantage": normalize, "normalize_rewards": True}
    one, other = a2c(spec, **settings), ppo(spec, **settings)
    assert torch.equal(one.net.flat, other.net.flat)
    rows = batch(one, 0)
    only_step(one, rows).assert_is(only_step(other, rows).gradient)


def constant_critic(algorithm: A2C | REINFORCE, value: float) -> None:
    with torch.no_grad():
        algorithm.net.parameters["critic.out.weight"].zero_()
        algorithm.net.parameters["critic.out.bias"].fill_(value)


def test_with_lambda_1_no_bootstrap_and_values_of_0_its_gradient_is_reinforces() -> None:
    one, other = a2c(**FREE, gae_lambda=1.0), reinforce(**FREE, baseline=False, normalize_returns=False)
    constant_critic(one, 0.0)
    rows = whole(batch(one, 0))
    only_step(one, rows).assert_is(only_step(other, rows).gradient, slice(one.net.acting_size))


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_a_constant_baseline_is_the_same_in_both(value: float) -> None:
    one, other = a2c(**FREE), reinforce(**FREE, normalize_returns=False)
    for each in (one, other):
        constant_critic(each, value)
    rows = whole(batch(one, 0))
    only_step(one, rows).assert_is(only_step(other, rows).gradient)


def test_a_constant_baseline_changes_nothing_that_is_normalized() -> None:
    one, other = a2c(**FREE, normalize_advantage=True), reinforce(**FREE, baseline=False)
    constant_critic(one, 5.0)
    rows = whole(batch(one, 0))
    returns = Rows(
        rows.reward, np.full((len(rows.reward) + 1, rows.reward.shape[1]), 5.0), rows.terminated, rows.truncated, rows.valid
    )
    errors = Errors(advantage=2 * float(gae_tolerance(returns, FREE["gamma"], 1.0).max()))
    only_step(one, rows, errors).assert_is(only_step(other, rows).gradient, slice(one.net.acting_size))


def test_rewards_are_scaled_when_they_are_to_be() -> None:
    plain, scaled = a2c(), a2c(normalize_rewards=True)
    losses = [each.update(batch(each, 0), no_pulse)["train/value_loss"] for each in (plain, scaled)]
    assert losses[1] < losses[0] / 4
