"""Running mean and variance of observation features and of the discounted return.

These statistics are computed in float64 with numpy, and saved as tensors. Only valid rows count. Only the learner updates
the statistics; workers act with the float32 buffers that the learner publishes.

Rule: no single observation may spoil the scale of the others. A value more than `FAR` standard deviations from the mean (a
far value) counts as if it were `CLIP` standard deviations away, which is what the policy sees. If a sensor fails in less
than one row in a hundred, the standard deviation therefore changes little. If the scale of a feature grows permanently, its
many far values quickly set a new scale. Values that are not far count unchanged. Until there are `FEW` rows, it is not known
which values are far, so all rows are kept until then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from msgspec.structs import replace

from millrace.learner.algorithms.returns import EpisodeEnds, discounted_return
from millrace.protocol.arrays import Array, Bools, Doubles, Floats
from millrace.protocol.policy.features import feature_size, features, leaf_of_features
from millrace.protocol.policy.normalize import CLIP, normalize
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec

TINY = 1e-12  # a smaller standard deviation is only a rounding error; the value did not vary
FAR = 100.0  # distance from the mean, in standard deviations, beyond which a value is far
FEW = 100  # number of rows after which the scale counts as known
ROUNDING_32 = 1e-6  # rounding error of float32, as a fraction of the mean
ROUNDING_64 = 1e-12  # rounding error of float64, as a fraction of the mean


class RunningMoments:
    """Mean and variance [*shape] of all rows so far, updated batch by batch (Chan, Golub and LeVeque 1979)."""

    def __init__(self, shape: tuple[int, ...] = (), rounding: float | Doubles = ROUNDING_32) -> None:
        """`rounding` is the relative rounding error of the values' dtype: one number, or an array [*shape]."""
        self.count = 0
        self._rounding = rounding
        self.mean: Doubles = np.zeros(shape)
        self._squares: Doubles = np.zeros(shape)  # summed squared distances from the mean

    def update(self, rows: npt.NDArray[Any]) -> None:
        """Add rows [B, *shape] to the mean and the variance."""
        if not len(rows):
            return
        mean = rows.mean(0, dtype=np.float64)
        distance = mean - self.mean
        total = self.count + len(rows)
        self._squares = self._squares + ((rows - mean) ** 2).sum(0) + distance**2 * (self.count * len(rows) / total)
        self.mean = self.mean + distance * (len(rows) / total)
        self.count = total

    @property
    def std(self) -> Doubles:
        """Standard deviation [*shape] of the population; 1 where the values varied by no more than rounding errors.

        Where the mean is so large that its rounding error may exceed 1, it is this error instead of 1.
        """
        variance = self._squares / max(self.count, 1)
        rounding = self._rounding * abs(self.mean)
        return np.where(variance > rounding**2 + TINY**2, np.sqrt(variance), np.maximum(rounding, 1.0))

    def state_dict(self) -> dict[str, Any]:
        """A copy of the state, as tensors and numbers."""
        return {"count": self.count, "mean": torch.tensor(self.mean), "squares": torch.tensor(self._squares)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self.count = int(state["count"])
        shape = self.mean.shape
        self.mean, self._squares = (np.broadcast_to(state[name].numpy(), shape).copy() for name in ("mean", "squares"))


class ObservationNormalizer:
    """Means and standard deviations of the features of Box observations. One-hot and binary features aren't normalized."""

    def __init__(self, spec: PolicySpec) -> None:
        self._acting = feature_size(spec)
        self._spec = spec = replace(spec, observation=spec.seen, critic=())
        self._enabled = spec.normalize_observations
        leaves = leaf_of_features(spec)
        self._box_features = np.array([leaf.kind == "box" for leaf in leaves], bool)
        self._is_wide = np.array([leaf.is_wide for leaf in leaves], bool)
        self._moments = self._no_moments()
        self._first: Doubles = np.empty((0, len(leaves)))  # [K, D] the first rows, kept while there are fewer than `FEW`

    def _no_moments(self) -> RunningMoments:
        return RunningMoments((len(self._is_wide),), np.where(self._is_wide, ROUNDING_64, ROUNDING_32))

    def inputs(self, leaves: Sequence[Array], published: Floats) -> tuple[Array, list[Array]]:
        """The network's input for leaves [..., *leaf]: features [..., D], and the images among the leaves.

        `published` are the `buffers` that workers act with. They may be older than the newest statistics.
        """
        raw = self.raw(leaves)
        x = normalize(raw, *np.split(published, 2)) if self._enabled else raw
        return x, [array for leaf, array in zip(self._spec.observation, leaves, strict=True) if leaf.is_image]

    def raw(self, leaves: Sequence[Array]) -> Array:
        """Features [..., D] of leaves [..., *leaf], not normalized."""
        return features(self._spec, leaves)

    def published(self, buffers: Floats) -> Floats:
        """The part of `buffers` that workers need to act. It omits the features that only the critic sees."""
        return np.concatenate([half[: self._acting] for half in np.split(buffers, 2)]) if self._enabled else buffers

    def update(self, raw: Floats | Doubles, valid: npt.NDArray[np.bool_]) -> None:
        """Add the raw features [T, N, D] of the valid rows to the statistics. `valid` is [T, N]."""
        if not self._enabled:
            return
        rows = raw[valid]
        if self._moments.count >= FEW:
            self._moments.update(_bounded(rows, self._moments.mean, self._moments.std))
        elif self._moments.count + len(rows) < FEW:
            self._moments.update(rows)
            self._first = np.concatenate([self._first, rows])
        else:
            self._update_with_first(rows)

    def _update_with_first(self, rows: Floats | Doubles) -> None:
        """Add the rows [B, D] that bring the total to `FEW` or more.

        The scale is set by the 99 % of all values so far that are nearest to the median.
        """
        so_far = np.concatenate([self._first, rows]) if len(self._first) else rows
        center = np.median(so_far, 0)
        spread = np.quantile(abs(so_far - center), 0.99, axis=0, method="lower")
        bounded = _bounded(so_far, center, np.where(spread > 0, spread, 1))
        if bounded is so_far:
            self._moments.update(rows)
        else:
            self._moments = self._no_moments()
            self._moments.update(bounded)
        self._first = self._first[:0]

    def buffers(self) -> Floats:
        """D means, then D standard deviations, float32, as published; empty if the policy does not normalize.

        A feature with a large mean, such as a time in seconds, may vary by less than the rounding error of its mean in
        float32. The standard deviation of such a feature is computed about the rounded mean, so that normalized values have
        a mean square of 1 and are not clipped.
        """
        if not self._enabled:
            return np.empty(0, np.float32)
        mean = np.where(self._box_features, self._moments.mean, 0).astype(np.float32)
        off = np.where(self._is_wide, mean - self._moments.mean, 0)
        std = np.where(self._box_features, np.hypot(self._moments.std, off), 1)
        return np.concatenate([mean, std.astype(np.float32)])

    def state_dict(self) -> dict[str, Any]:
        """A copy of the state, as tensors and numbers."""
        first = {"first": torch.tensor(self._first)} if len(self._first) else {}
        return self._moments.state_dict() | first

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._moments.load_state_dict(state)
        first = state.get("first", torch.empty(0))
        D = len(self._is_wide)
        if len(first) and (len(first) >= FEW or first.shape[1:] != (D,)):
            raise ValueError(f"observations: expected fewer than {FEW} first rows of {D} numbers, got {list(first.shape)}")
        self._first = first.numpy().astype(np.float64).reshape(len(first), D)


def _bounded(rows: Floats | Doubles, center: Floats | Doubles, spread: Floats | Doubles) -> Floats | Doubles:
    """The rows [B, D], in which values far from the center [D] are replaced. Returns the same array if no value is far."""
    distance = rows - center.astype(rows.dtype)
    if (np.einsum("bd,bd->d", distance, distance) <= (FAR * spread) ** 2).all():
        return rows  # as for most batches: if a feature's squares sum to no more than the limit squared, none is far
    far = abs(distance) > FAR * spread
    return np.where(far, center + np.copysign(CLIP * spread, distance), rows) if far.any() else rows


def continued(by_lane: Mapping[int, Doubles], lane: int, fresh: Bools) -> Doubles:
    """The running sums [N] of a lane's env copies at the beginning of a rollout: 0 for copies that are `fresh` [N]."""
    known = 0.0 if fresh.all() else by_lane.get(lane, 0.0)  # a fresh lane may have more or fewer env copies
    return np.where(fresh, 0.0, known)


class RewardScaler:
    """Divides rewards by the running standard deviation of the discounted return, without a shift (Engstrom et al. 2020).

    The return of each env copy continues from one rollout of its lane to the next. It starts at 0 with each episode and
    whenever a lane gets new env copies.
    """

    def __init__(self, gamma: float) -> None:
        self._gamma = gamma
        self._moments = RunningMoments()
        self._returns: dict[int, Doubles] = {}  # by lane, the running return [columns] of each env copy

    def count_and_scale(self, batch: Batch) -> Floats:
        """Add the batch to the statistics, then return its rewards [T, ΣN], scaled and clipped to ±10."""
        self.count(batch)
        return self.scaled(batch.reward)

    def scaled(self, reward: Floats) -> Floats:
        """These rewards, float32, scaled and clipped to ±10 as in Stable-Baselines3's VecNormalize."""
        clipped: Floats = np.clip(reward / self.std, -CLIP, CLIP).astype(np.float32)
        return clipped

    @property
    def std(self) -> float:
        """The standard deviation of the discounted return; 1 before any reward is counted."""
        return float(self._moments.std)

    def count(self, batch: Batch) -> None:
        """Add the rewards of a batch to the statistics."""
        ends = EpisodeEnds.of(batch)
        for at in range(0, len(batch.lane), batch.columns_per_rollout):  # a lane's rollouts are in order of collection
            columns = slice(at, at + batch.columns_per_rollout)
            lane = int(batch.lane[at])
            reward, fresh, of_lane = batch.reward[:, columns], batch.fresh[columns], ends.columns(columns)
            start = continued(self._returns, lane, fresh)
            returns, self._returns[lane] = discounted_return(reward, of_lane, self._gamma, start)
            self._moments.update(returns[of_lane.valid])
            self.counted(returns, reward, of_lane, lane, fresh)

    def counted(self, returns: Doubles, reward: Floats, ends: EpisodeEnds, lane: int, fresh: Bools) -> None:
        """Called for each rollout, with its discounted returns and rewards [T, N]. A subclass may count more.

        `fresh` [N] is True for env copies that don't continue the lane's last rollout.
        """

    def state_dict(self) -> dict[str, Any]:
        """A copy of the state, as tensors and numbers."""
        return {
            "moments": self._moments.state_dict(),
            "returns": {lane: torch.tensor(returns) for lane, returns in self._returns.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._moments.load_state_dict(state["moments"])
        self._returns = {int(lane): returns.numpy().copy() for lane, returns in state["returns"].items()}
