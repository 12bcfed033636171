"""IMPALA: the loss of the paper on rows that older weights acted, and A2C's where they are the newest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from millrace.learner.algorithms.a2c import A2C
from millrace.learner.algorithms.actor_critic import ActorCritic, Estimates
from millrace.learner.algorithms.impala import IMPALA
from millrace.learner.algorithms.minibatches import Minibatch
from millrace.learner.config.hyperparameters import A2CConfig, IMPALAConfig
from millrace.protocol.arrays import Array
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec
from tests.learner.algorithms.test_returns import Rows
from tests.learner.algorithms.test_vtrace import OffPolicy, on_policy, slow_vtrace, vtrace_tolerances
from tests.support.numbers.batches import DISCRETE, GAUSSIAN, batch, identity_batch, no_pulse, normal, shared
from tests.support.numbers.rounding import ELEMENTWISE, UNIT, assert_within, in_double, in_float64, sampled
from tests.support.numbers.steps import Errors, only_step, usual_distribution, watched

GAMMA = 0.9


def impala(spec: PolicySpec = DISCRETE, seed: int = 0, **settings: Any) -> IMPALA:
    settings = {"max_grad_norm": 1e9, **settings}
    return IMPALA(IMPALAConfig(gamma=GAMMA, **settings), spec, total_steps=10_000, seed=seed)


@pytest.mark.parametrize("spec", [DISCRETE, normal(GAUSSIAN), shared(DISCRETE)])
@pytest.mark.parametrize("lam", [1.0, 0.7])
def test_on_rows_of_the_newest_weights_its_gradient_is_a2cs(spec: PolicySpec, lam: float) -> None:
    config = A2CConfig(gamma=GAMMA, max_grad_norm=1e9, gae_lambda=lam, ent_coef=0.01, normalize_rewards=True)
    one, twin = (impala(spec, vtrace_lambda=lam, ent_coef=0.01, normalize_rewards=True) for _ in range(2))
    other, others_twin = (A2C(config, spec, total_steps=10_000, seed=0) for _ in range(2))
    rows = batch(one, 0)
    found, expected = estimated(twin, rows), estimated(others_twin, rows)
    returns = Rows(rows.reward, expected.values, rows.terminated, rows.truncated, rows.valid)
    of_log_prob = log_prob_error(one, rows)
    of_target, of_advantage = vtrace_tolerances(on_policy(returns), GAMMA, lam, log_ratio_error=of_log_prob)
    assert_within(found.target[rows.valid], expected.target[rows.valid], 2 * of_target[rows.valid])  # both are rounded
    assert_within(found.advantage, expected.advantage, 2 * of_advantage)
    step = only_step(one, rows, largest_differences(found, expected.advantage, expected.target))
    step.assert_is(only_step(other, rows).gradient)
    assert abs(step.metrics["train/rho"] - 1) < of_log_prob + (rows.env_steps + ELEMENTWISE) * UNIT


def estimated(algorithm: ActorCritic, rows: Batch) -> Estimates:
    """The estimates of the first update."""
    return algorithm.estimate(rows, algorithm.observations(rows), rows.reward, no_pulse)


def largest_differences(found: Estimates, advantage: Array, target: Array) -> Errors:
    """Of the rows to learn from. A test asserts first that the differences are rounding."""
    pairs = (found.advantage, advantage), (found.target, target)
    return Errors(*(float(np.abs(one - other)[found.used].max()) for one, other in pairs))


def log_prob_error(algorithm: IMPALA, rows: Batch) -> float:
    """How far two float32 log-probabilities of the actions of this batch may differ under the algorithm's weights."""
    x = algorithm.observations(rows).features[: rows.valid.size].double()
    action, exact = in_double(torch.from_numpy(rows.action).flatten(0, 1)), in_float64(algorithm.net)
    ((_, tolerance),) = sampled(lambda: [exact.evaluate(x, (), None, action)[0]])
    return float(tolerance.max())


@pytest.mark.parametrize("spec", [DISCRETE, GAUSSIAN])
def test_on_rows_of_older_weights_it_follows_the_gradient_of_the_papers_loss(spec: PolicySpec) -> None:
    algorithm = impala(spec, vf_coef=0.7, ent_coef=0.3, rho_bar=1.2, c_bar=0.9, vtrace_lambda=0.8)
    older = impala(spec, seed=1)
    with torch.no_grad():
        algorithm.net.parameters["actor.out.weight"].mul_(60)  # far from the older policy
    rows = batch(older, 0)
    valid = torch.from_numpy(rows.valid.flatten())
    x, action = torch.from_numpy(rows.obs[0]).flatten(0, 1), torch.from_numpy(rows.action).flatten(0, 1)
    params, value = algorithm.net.forward(x)
    usual = usual_distribution(spec, params[: len(action)])
    log_prob = usual.log_prob(action)
    log_ratio = log_prob.detach().numpy().reshape(rows.valid.shape) - rows.log_prob
    values = value.detach().numpy().reshape(len(rows.valid) + 1, -1)
    bars = GAMMA, 0.8, 1.2, 0.9
    o = OffPolicy(Rows(rows.reward, values, rows.terminated, rows.truncated, rows.valid), log_ratio)
    target, advantage = (torch.from_numpy(each).flatten().float() for each in slow_vtrace(o, *bars))
    policy_loss = -(log_prob * advantage)[valid].mean()
    value_loss = (value[: len(target)] - target)[valid].square().mean()
    (policy_loss + 0.7 * value_loss - 0.3 * usual.entropy()[valid].mean()).backward()
    expected = algorithm.net.flat_grad.numpy().copy()
    # Targets and advantages are linear in the values, and so are their errors.
    exact_net = in_float64(algorithm.net)
    ((_, of_value),) = sampled(lambda: [exact_net.value(x.double())])
    of_values = np.full_like(values, of_value.max())
    of_means = slow_vtrace(o._replace(rows=o.rows._replace(reward=0 * rows.reward, values=of_values)).sizes, *bars)
    of_sums = vtrace_tolerances(o, *bars, log_ratio_error=log_prob_error(algorithm, rows))
    of_target, of_advantage = (one + other for one, other in zip(of_sums, of_means, strict=True))
    found = estimated(algorithm, rows)
    exact = advantage.numpy().reshape(rows.valid.shape), target.numpy().reshape(rows.valid.shape)
    assert_within(found.advantage, exact[0], of_advantage)
    assert_within(found.target, exact[1], of_target)
    step = only_step(algorithm, rows, largest_differences(found, *exact))
    step.assert_is(expected)
    assert step.metrics["train/rho"] < 0.9


def by_row(given: list[Minibatch]) -> list[tuple[float, ...]]:
    """Rows of minibatches, sorted: features, advantage, target."""
    return sorted(
        (*m.features[i].tolist(), float(m.advantage[i]), float(m.target[i])) for m in given for i in range(len(m.features))
    )


def test_vtrace_is_computed_in_time_order_before_rows_are_shared_out() -> None:
    whole, shared_out = impala(), impala(minibatches=4)
    rows = batch(impala(seed=1), 0)
    once, parts = watched(whole), watched(shared_out)
    pulses: list[int] = []
    whole.update(rows, no_pulse)
    shared_out.update(rows, lambda: pulses.append(1))
    count = int(rows.valid.sum())
    assert len(once) == 1
    assert {len(each.features) for each in parts} <= {count // 4, count // 4 + 1}
    assert len(parts) == 4 < len(pulses)
    assert by_row(parts) == by_row(once)
    assert parts[0].features.tolist() != sorted(parts[0].features.tolist())


def test_vtrace_is_computed_anew_for_each_epoch() -> None:
    algorithm = impala(n_epochs=2, learning_rate=0.05, optimizer="adam")
    seen = watched(algorithm)
    rows = batch(algorithm, 0)
    algorithm.update(rows, no_pulse)
    first, second = seen
    assert sorted(first.features.tolist()) == sorted(second.features.tolist())
    assert by_row([first]) != by_row([second])


@pytest.mark.parametrize("spec", [normal(DISCRETE), normal(GAUSSIAN)])
def test_it_learns_the_identity_from_rows_four_versions_old(spec: PolicySpec) -> None:
    algorithm = impala(spec, learning_rate=0.01, optimizer="adam", max_grad_norm=0.5)
    generator = np.random.default_rng(0)
    waiting, scores = [], []
    for _ in range(200):
        rows, score = identity_batch(algorithm, generator)
        waiting.append(rows)
        scores.append(score)
        if len(waiting) > 4:
            algorithm.update(waiting.pop(0), no_pulse)
    assert np.mean(scores[-3:]) > (0.95 if spec.action.kind == "discrete" else -0.45)
