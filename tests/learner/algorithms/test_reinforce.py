"""REINFORCE: exactly the rows whose return is known, and runs refused in which that could be none."""

from __future__ import annotations

from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
import torch

from millrace.learner.algorithms.minibatches import LossInput, Minibatch
from millrace.learner.algorithms.reinforce import REINFORCE
from millrace.learner.config.hyperparameters import REINFORCEConfig
from millrace.learner.config.layers import resolve
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UsageError
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec
from tests.learner.algorithms.test_returns import Rows, gae_tolerance, sum_tolerance
from tests.support.in_process.described import run_spec
from tests.support.numbers.batches import DISCRETE, GAUSSIAN, batch, no_pulse
from tests.support.numbers.rounding import ELEMENTWISE, UNIT, assert_within

GAMMA = 0.9


def reinforce(spec: PolicySpec = DISCRETE, **settings: Any) -> REINFORCE:
    settings = {"normalize_rewards": False, **settings}
    return REINFORCE(REINFORCEConfig(gamma=GAMMA, **settings), spec, total_steps=10_000, seed=0)


def slow_returns(rows: Batch, values: np.ndarray[Any, Any] | None) -> list[tuple[int, int, float]]:
    """(t, n, G) of every row whose episode ends within the rollout; G goes on with a value where the clock ended it."""
    found = []
    T, N = rows.reward.shape
    for t, n in np.ndindex(T, N):
        g = 0.0
        for k in range(t, T):
            if not rows.valid[k, n]:
                break
            g += GAMMA ** (k - t) * float(rows.reward[k, n])
            if rows.terminated[k, n] or rows.truncated[k, n]:
                if values is not None and not rows.terminated[k, n]:
                    g += GAMMA ** (k - t + 1) * float(values[k + 1, n])
                found.append((t, n, g))
                break
    return found


@pytest.mark.parametrize("baseline", [True, False])
@pytest.mark.parametrize("normalize", [True, False])
@pytest.mark.parametrize("spec", [DISCRETE, GAUSSIAN])
def test_it_learns_from_the_known_returns_alone(
    monkeypatch: pytest.MonkeyPatch, baseline: bool, normalize: bool, spec: PolicySpec
) -> None:
    algorithm = reinforce(spec, baseline=baseline, normalize_returns=normalize)
    rows = batch(algorithm, 0)
    values = algorithm.values(algorithm.observations(rows), no_pulse)
    expected = slow_returns(rows, values if baseline else None)
    assert 0 < len(expected) < rows.valid.sum()
    advantage = np.array([g - (values[t, n] if baseline else 0) for t, n, g in expected])
    of_value = values if baseline else np.zeros_like(values)
    columns = Rows(rows.reward, of_value, rows.terminated, rows.truncated, rows.valid)
    of_return = np.array([gae_tolerance(columns, GAMMA, 1.0)[t, n] for t, n, _ in expected])
    tolerance = of_return
    if normalize:
        # It divides errors by the standard deviation; mean and deviation are off as well, and are sums of all rows.
        sizes, std = np.abs(advantage) + of_return, advantage.std(ddof=1)
        advantage = (advantage - advantage.mean()) / std
        of_sums = sum_tolerance(sizes.max(), len(sizes) + ELEMENTWISE)
        tolerance = (of_return + (1 + np.abs(advantage)) * (of_return.max() + of_sums)) / std
    assert (algorithm.vf_coef > 0) == baseline
    evaluated: list[tuple[Minibatch, LossInput]] = []
    evaluate = algorithm.evaluate

    def recorded_evaluate(minibatch: Minibatch) -> LossInput:
        evaluated.append((minibatch, evaluate(minibatch)))
        return evaluated[-1][1]

    monkeypatch.setattr(algorithm, "evaluate", recorded_evaluate)
    metrics = algorithm.update(rows, no_pulse)
    ((minibatch, only),) = evaluated
    np.testing.assert_array_equal(minibatch.features, [rows.obs[0][t, n] for t, n, _ in expected])
    assert_within(only.advantage.numpy(), advantage, tolerance)
    if baseline:
        returns = np.array([g for _, _, g in expected])
        assert_within(only.target.numpy(), returns, of_return + UNIT * (np.abs(returns) + of_return))  # it is rounded
    assert metrics["train/rows_used"] == len(expected)
    assert metrics["train/rows_dropped"] == rows.valid.sum() - len(expected)


def test_without_a_baseline_the_critic_stays_as_it_is() -> None:
    algorithm = reinforce(baseline=False)
    before = algorithm.net.flat.clone()
    algorithm.update(batch(algorithm, 0), no_pulse)
    acting = algorithm.net.acting_size
    assert torch.equal(algorithm.net.flat[acting:], before[acting:])
    assert not torch.equal(algorithm.net.flat[:acting], before[:acting])


def test_a_batch_in_which_no_episode_ends_is_counted_and_changes_no_weight() -> None:
    algorithm = reinforce(normalize_rewards=True)
    rows = batch(algorithm, 0)
    none = np.zeros_like(rows.valid)
    rows = msgspec.structs.replace(rows, terminated=none, truncated=none, valid=~none)
    before = algorithm.net.flat.clone()
    metrics = algorithm.update(rows, no_pulse)
    assert torch.equal(algorithm.net.flat, before)
    assert (metrics["train/rows_used"], metrics["train/rows_dropped"]) == (0, none.size)
    assert (algorithm.env_steps, algorithm.version) == (none.size, 1)


def spec_of(env: EnvSpec, steps: int, algo: str = "reinforce") -> int:
    return run_spec(resolve(env.id, algo=algo, preset="none", rollout_steps=steps), env).rollout_steps


def test_rollouts_shorter_than_an_episode_can_be_are_refused() -> None:
    with pytest.raises(UsageError) as refused:
        spec_of(EnvSpec("CartPole-v1"), 500)
    assert str(refused.value) == (
        "rollout_steps 500: reinforce learns from whole episodes, and those of CartPole-v1 take up to 500 steps; "
        "expected at least 501"
    )
    assert spec_of(EnvSpec("CartPole-v1"), 501) == 501
    assert spec_of(EnvSpec("CartPole-v1"), 8, "a2c") == 8


def test_where_nothing_says_how_long_an_episode_can_be_nothing_is_refused() -> None:
    def endless() -> gymnasium.Env[Any, Any]:
        return gymnasium.make("CartPole-v1").unwrapped

    assert spec_of(EnvSpec("CartPole-v1", {"max_episode_steps": -1}), 8) == 8
    assert spec_of(EnvSpec.of(endless), 600) == 600
