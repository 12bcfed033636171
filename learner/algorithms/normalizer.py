"""`RolloutService.normalizer`: the running mean and standard deviation of observations and of the discounted return.

The built-in trainer uses the same classes, and updates them from the same rows. `RolloutService` imports this module, and
therefore torch, when the normalizer is first used.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import torch

from millrace.learner.algorithms.running_statistics import ObservationNormalizer, RewardScaler
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.features import feature_size, features
from millrace.protocol.policy.normalize import normalize
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec


class Normalizer:
    """Running mean and standard deviation of each feature of the observations, and of the discounted return.

    These statistics cover all batches counted so far, except rows that only reset. D is the number of features: the
    observation's arrays are flattened and concatenated, with a one-hot vector for each discrete value. Images aren't
    features and aren't normalized. The statistics are kept in float64 and returned as float32.

    >>> import millrace
    >>> policy = millrace.MLP(normalize_observations=True)
    >>> with millrace.RolloutService("CartPole-v1", policy, workers=1, envs=2, lanes=1, rollout_steps=8) as service:
    ...     parameters = service.policy.initial()
    ...     _ = service.publish(parameters)
    ...     batch = service.gather()
    ...     features = service.normalizer.normalized(batch)    # as the policy saw them, for your loss
    ...     reward = service.normalizer.scaled_rewards(batch, 0.99)
    ...     service.normalizer.update(batch)
    ...     service.publish(parameters)                     # sends mean and standard deviation, too
    1
    >>> isinstance(service.normalizer, millrace.Normalizer)
    True

    `service.save` saves the statistics, and a restored service continues from them.
    """

    def __init__(self, policy: PolicySpec) -> None:
        """Create a normalizer for this policy's observations, even if the policy doesn't normalize them itself."""
        self._policy = msgspec.structs.replace(policy, normalize_observations=True)
        self._observations = ObservationNormalizer(self._policy)
        self._size = feature_size(self._policy)
        self._rewards: tuple[float, RewardScaler] | None = None

    @property
    def mean(self) -> Floats:
        """[D] float32 mean of each feature of the observation; 0 for features of discrete values."""
        return self.buffers()[: self._size]

    @property
    def std(self) -> Floats:
        """[D] float32 standard deviation about `mean`; 1 if a feature never varied or belongs to a discrete value."""
        return self.buffers()[self._size :]

    def buffers(self) -> Floats:
        """`mean`, then `std`, in one array [2 D] float32: the buffers to `publish` for a policy that normalizes."""
        return self._observations.buffers()

    def update(self, batch: Batch) -> None:
        """Add the observations of a batch to the statistics. Call this once for each batch, after `normalized`."""
        self._observations.update(self._features(batch)[:-1], batch.valid)

    def normalized(self, batch: Batch) -> Floats:
        """The features [T+1, N, D] float32 of a batch: (x − mean) / std, clipped to ±10.

        If you call this before `update`, these are the features that the policy saw, provided that the policy normalizes and
        that `max_lag` is 0. The observation's arrays are flattened and concatenated; discrete values become one-hot vectors,
        and the bytes of a Box from 0 to 255 are first divided by 255.
        """
        return normalize(self._features(batch), self.mean, self.std)

    def scaled_rewards(self, batch: Batch, gamma: float) -> Floats:
        """Add the rewards of a batch to the statistics, and return them scaled, as an array [T, N].

        Rewards are divided by the standard deviation of the discounted return, and clipped to ±10. Call this once for each
        batch. `gamma` is the discount factor. Raises `UsageError` if `gamma` isn't the same each time.
        """
        if self._rewards is None:
            self._rewards = gamma, RewardScaler(gamma)
        if gamma != self._rewards[0]:
            raise UsageError(f"normalizer: gamma: expected {self._rewards[0]} as in the batches before, got {gamma}")
        return self._rewards[1].count_and_scale(batch)

    def _features(self, batch: Batch) -> Array:
        obs: Any = batch.obs
        paths = [leaf.path for leaf in self._policy.observation]
        return features(self._policy, [obs[path] for path in paths] if paths[0] else [obs])

    def state(self) -> dict[str, Any]:
        """The state for `restore`, as plain data. Running returns are omitted, because a restored service has new copies."""
        kept: dict[str, Any] = {"observations": _plain(self._observations.state_dict())}
        if self._rewards is not None:
            gamma, scaler = self._rewards
            kept |= {"gamma": gamma, "rewards": _plain(scaler.state_dict()["moments"])}
        return kept

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the result of `state`. Raises an exception, of any type, if the state is malformed or not finite."""
        self._observations.load_state_dict(_tensors(state["observations"]))
        if "gamma" in state:
            scaler = RewardScaler(state["gamma"])
            scaler.load_state_dict(scaler.state_dict() | {"moments": _tensors(state["rewards"])})
            self._rewards = state["gamma"], scaler


def _plain(moments: dict[str, Any]) -> dict[str, Any]:
    return {name: value.tolist() if isinstance(value, torch.Tensor) else value for name, value in moments.items()}


def _tensors(moments: dict[str, Any]) -> dict[str, Any]:
    state: dict[str, Any] = {}
    for name, value in moments.items():
        if name == "count":
            state[name] = value
            continue
        array = np.asarray(value, np.float64)
        if not np.isfinite(array).all():
            raise ValueError(f"normalizer: {name}: expected finite numbers")
        state[name] = torch.tensor(array)
    return state
