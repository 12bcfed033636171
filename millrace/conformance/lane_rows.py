"""What must hold between the rollouts of one lane: they continue each other, and their sums are right. Pure.

It recomputes what a learner can: which rows are valid, the returns and lengths of episodes, and the log-probabilities of the
actions under the weights that acted, by the numpy policy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.conformance import rules
from millrace.conformance.script import Broken
from protocol.arrays import Array, Floats
from protocol.messages import Weights
from protocol.policy.distributions import distribution
from protocol.policy.policy import make_policy
from protocol.rollout import Rollout
from protocol.specs import RunSpec
from protocol.wire.weight_dtypes import to_float32

RETURN_TOLERANCE = 1e-4  # relative: the rows carry rewards in float32, the sums are of float64
LOG_PROB_TOLERANCE = 1e-3  # absolute: another order of additions gives other last bits


class LaneRows:
    """The rollouts of one lane and incarnation, in order."""

    def __init__(self, run: RunSpec) -> None:
        self._run = run
        self._last: Rollout | None = None
        self._return = np.zeros(run.copies)
        self._length = np.zeros(run.copies, np.int64)

    def see(self, rollout: Rollout, weights: Weights) -> None:
        """Check the next rollout, which keeps the row format. Raises `Broken`."""
        self._check_begin(rollout)
        self._check_episodes(rollout)
        if can_be_recomputed(self._run):
            self._check_log_prob(rollout, weights)
        self._last = rollout

    def _check_begin(self, rollout: Rollout) -> None:
        last = self._last
        ended = np.zeros(self._run.copies, bool) if last is None else last.terminated[-1] | last.truncated[-1]
        if (wrong := rollout.valid[0] == ended).any():
            n = int(np.argmax(wrong))
            raise Broken(
                rules.FIRST_VALID,
                f"valid[0] {not ended[n]} in copy {n} of sequence {rollout.sequence}: "
                f"{'the last row of the rollout before ended its episode' if ended[n] else 'no episode had ended'}",
                f"{bool(rollout.valid[0, n])}",
            )
        if last is not None:
            for one, other in zip(last.obs, rollout.obs, strict=True):
                if one[-1].tobytes() != other[0].tobytes():
                    raise Broken(
                        rules.CONTINUES,
                        f"obs[0] of sequence {rollout.sequence} to be obs[T] of sequence {last.sequence}",
                        "another observation",
                    )
        if rollout.reward[~rollout.valid].any():
            raise Broken(rules.ROWS, "reward 0 in rows that are not valid", f"{rollout.reward[~rollout.valid].max()}")

    def _check_episodes(self, rollout: Rollout) -> None:
        expected: list[tuple[float, int]] = []
        for t in range(self._run.rollout_steps):
            valid = rollout.valid[t]
            self._return += np.where(valid, rollout.reward[t].astype(np.float64), 0.0)
            self._length += valid
            for n in np.flatnonzero(valid & (rollout.terminated[t] | rollout.truncated[t])).tolist():
                expected.append((float(self._return[n]), int(self._length[n])))
                self._return[n], self._length[n] = 0.0, 0
        got = [(episode.reward, episode.length) for episode in rollout.episodes]  # `validate` has counted them
        if not _same(expected, got) and _same(sorted(expected), sorted(got)):
            lengths = [length for _, length in expected]
            raise Broken(
                rules.EPISODE_ORDER,
                f"episodes of sequence {rollout.sequence} of the lengths {lengths}, in the order of their last steps",
                f"{[length for _, length in got]}",
            )
        for (total, length), episode in zip(expected, rollout.episodes, strict=True):
            if episode.length != length:
                raise Broken(
                    rules.EPISODES, f"length {length}, as the rows of sequence {rollout.sequence} say", f"{episode.length}"
                )
            if not is_return(episode.reward, total):
                expected_return = f"return {total:g}, the sum of the rewards of its {length} steps"
                raise Broken(rules.EPISODES, expected_return, f"{episode.reward:g}")

    def _check_log_prob(self, rollout: Rollout, weights: Weights) -> None:
        params = params_of(self._run, weights, [leaf[:-1] for leaf in rollout.obs])
        expected = distribution(self._run.policy).log_prob(params, rollout.action)
        apart = np.where(rollout.valid, np.abs(expected - rollout.log_prob), 0.0)
        if (apart > LOG_PROB_TOLERANCE * np.maximum(1.0, np.abs(expected))).any():
            t, n = np.unravel_index(int(apart.argmax()), apart.shape)
            rounded = weights.parameters.dtype != np.float32
            normalized = self._run.policy.normalize_observations
            raise Broken(
                rules.ROUNDED if rounded else rules.NORMALIZED if normalized else rules.LOG_PROB,
                f"log_prob {expected[t, n]:.5f} at step {t}, copy {n} (within {LOG_PROB_TOLERANCE:g}), for action "
                f"{rollout.action[t, n].tolist()} under version {rollout.version}",
                f"{rollout.log_prob[t, n]:.5f}",
            )


def can_be_recomputed(run: RunSpec) -> bool:
    """Whether the numpy policy acts as this run's policy does."""
    return run.policy.own is None and not run.policy.needs_torch


def params_of(run: RunSpec, weights: Weights, obs: Sequence[Array]) -> Floats:
    """Distribution parameters [L, N, P] of these observations [L, N, *leaf], under these weights."""
    policy = make_policy(run.policy)
    policy.load(to_float32(weights.parameters), weights.buffers)
    return policy(obs)


def is_return(got: float, total: float) -> bool:
    """Whether a return is this sum of rewards."""
    return abs(got - total) <= RETURN_TOLERANCE * max(1.0, abs(total))


def _same(one: list[tuple[float, int]], other: list[tuple[float, int]]) -> bool:
    """Whether these episodes have the same returns and lengths, in this order."""
    return all(a == b and is_return(y, x) for (x, a), (y, b) in zip(one, other, strict=True))
