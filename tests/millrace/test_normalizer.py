"""`RolloutService.normalizer`: the running moments of the built-in trainer, for a learner of one's own."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import millrace
from millrace.learner.algorithms.running_statistics import ObservationNormalizer, RewardScaler

SMALL: dict[str, Any] = {"envs": 4, "lanes": 2, "workers": 1, "rollout_steps": 24, "transport": "inproc"}
POLICY = millrace.MLP(8, normalize_observations=True)


def log_probs(parameters: dict[str, Any], features: Any, action: Any) -> Any:
    h = np.tanh(features[:-1] @ parameters["actor.0.weight"].T + parameters["actor.0.bias"])
    logits = h @ parameters["actor.out.weight"].T + parameters["actor.out.bias"]
    logits = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
    return np.take_along_axis(logits, action[..., None], -1)[..., 0]


def test_they_are_those_of_all_valid_rows_and_the_policy_acts_with_them() -> None:
    seen = []
    with millrace.RolloutService("CartPole-v1", POLICY, **SMALL) as service:
        parameters = service.policy.initial(seed=1)
        service.publish(parameters)
        for batch in itertools.islice(service, 4):
            normalized = service.normalizer.normalized(batch)
            expected = log_probs(service.policy.named(parameters), normalized, batch.action)
            assert np.abs(expected - batch.log_prob)[batch.valid].max() < 1e-5
            service.normalizer.update(batch)
            seen.append(batch.obs[:-1][batch.valid])
            service.publish(parameters)
        rows = np.concatenate(seen).astype(np.float64)
        assert np.allclose(service.normalizer.mean, rows.mean(0), rtol=1e-6, atol=1e-7)
        assert np.allclose(service.normalizer.std, rows.std(0), rtol=1e-6)
        assert np.abs(service.normalizer.mean).min() > 0


def test_they_are_the_trainers_own() -> None:
    with millrace.RolloutService("CartPole-v1", POLICY, **SMALL) as service:
        service.publish(service.policy.initial())
        normalizer, scaler = ObservationNormalizer(service.run.policy), RewardScaler(0.9)
        for batch in itertools.islice(service, 3):
            service.normalizer.update(batch)
            normalizer.update(batch.obs[:-1], batch.valid)
            assert np.array_equal(service.normalizer.buffers(), normalizer.buffers())
            assert np.array_equal(service.normalizer.scaled_rewards(batch, 0.9), scaler.count_and_scale(batch))
            service.publish(service.policy.initial())
        with pytest.raises(millrace.UsageError, match=r"gamma: expected 0\.9 as in the batches before, got 0\.8"):
            service.normalizer.scaled_rewards(batch, 0.8)


def test_they_are_saved_and_restored(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    with millrace.RolloutService("CartPole-v1", POLICY, **SMALL) as service:
        service.publish(service.policy.initial())
        batch = service.gather()
        service.normalizer.update(batch)
        service.normalizer.scaled_rewards(batch, 0.9)
        service.publish(service.policy.initial())
        service.save(file)
        state = service.normalizer.state()
    with millrace.RolloutService("CartPole-v1", POLICY, restore=file, **SMALL) as service:
        assert service.normalizer.state() == state
        assert state["observations"]["count"] == batch.env_steps == state["rewards"]["count"]
        parameters = service.policy.initial()
        service.publish(parameters)  # with the moments that were restored
        batch = service.gather()
        expected = log_probs(service.policy.named(parameters), service.normalizer.normalized(batch), batch.action)
        assert np.abs(expected - batch.log_prob)[batch.valid].max() < 1e-5


def test_they_serve_a_policy_that_does_not_normalize() -> None:
    with millrace.RolloutService("CartPole-v1", **SMALL) as service:
        service.publish(service.policy.initial())
        batch = service.gather()
        service.normalizer.update(batch)
        assert service.normalizer.mean.shape == service.normalizer.std.shape == (4,)
        assert np.allclose(service.normalizer.mean, batch.obs[:-1][batch.valid].mean(0), atol=1e-6)
        assert service.normalizer.normalized(batch).shape == batch.obs.shape
        service.publish(service.policy.initial())


def test_of_several_arrays_the_features_are_side_by_side() -> None:
    with millrace.RolloutService("tests.support.envs.toy:Spaces-v0", env_kwargs={"observation": "dict"}, **SMALL) as service:
        service.publish(service.policy.initial())
        batch = service.gather()
        service.normalizer.update(batch)
        assert isinstance(batch.obs, dict)
        assert service.normalizer.normalized(batch).shape == (25, 4, len(service.normalizer.mean))
