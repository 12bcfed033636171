"""Checks that a lane's rollouts continue each other, and that their returns and log-probabilities are right. Pure.

It recomputes everything that a learner can recompute: which rows are valid, the returns and lengths of episodes, and, with
the numpy policy, the log-probabilities of the actions under the weights that chose them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.extras.conformance.script import Broken
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.messages import Rollout, Weights
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.rows.array_checks import place_of
from millrace.protocol.rules import Rule
from millrace.protocol.specs import RunSpec
from millrace.protocol.wire.weight_dtypes import to_float32

RETURN_TOLERANCE = 1e-4  # relative, because rewards in rows are float32 but returns are summed in float64
LOG_PROB_TOLERANCE = 1e-3  # absolute; adding in another order changes the last bits


class LaneRows:
    """The rollouts of one lane, in order, in one incarnation and in later ones that continue it."""

    def __init__(self, run: RunSpec) -> None:
        self._run = run
        self._last: Rollout | None = None
        self._return = np.zeros(run.copies)
        self._length = np.zeros(run.copies, np.int64)

    def see(self, rollout: Rollout, weights: Weights) -> None:
        """Check the next rollout, whose row format was already checked. Raises `Broken` if it breaks a rule."""
        self._check_begin(rollout)
        self._check_episodes(rollout)
        if can_be_recomputed(self._run):
            self._check_log_prob(rollout, weights)
        self._last = rollout

    def _check_begin(self, rollout: Rollout) -> None:
        last = self._last
        ended = np.zeros(self._run.copies, bool) if last is None else last.steps_that_reset[-1]
        if last is not None:
            for one, other in zip(last.obs, rollout.obs, strict=True):
                if one[-1].tobytes() != other[0].tobytes():
                    raise Broken(
                        Rule.CONTINUES if rollout.sequence else Rule.PAST,
                        f"obs[0] of sequence {rollout.sequence} to be obs[T] of sequence {last.sequence}",
                        "another observation",
                    )
        if (wrong := rollout.steps_that_reset[0] != ended).any():
            n = int(np.argmax(wrong))
            flag = "resets" if self._run.seats else "valid"
            raise Broken(
                Rule.FIRST_RESETS if self._run.seats else Rule.FIRST_VALID,
                f"{flag}[0] {ended[n] == bool(self._run.seats)} in copy {n} of sequence {rollout.sequence}: "
                f"{'the last row of the rollout before ended its episode' if ended[n] else 'no episode had ended'}",
                f"{ended[n] != bool(self._run.seats)}",
            )
        if rollout.reward[~rollout.valid].any():
            raise Broken(Rule.ROWS, "reward 0 in rows that are not valid", f"{rollout.reward[~rollout.valid].max()}")

    def _check_episodes(self, rollout: Rollout) -> None:
        run = self._run
        expected = list[tuple[float, int]]()
        reward = np.where(rollout.valid, rollout.reward.astype(np.float64), 0.0).reshape(-1, run.copies, run.seats_of_copy)
        steps = rollout.steps_that_reset
        for of_step, resets, over in zip(reward, steps, steps[1:], strict=False):
            self._return += of_step.sum(1)
            self._length += ~resets
            for n in np.flatnonzero(over & ~resets).tolist():
                expected.append((float(self._return[n]), int(self._length[n])))
                self._return[n] = 0.0
                self._length[n] = 0
        if run.seats:  # rewards outside of valid rows also count, so only the facts contain the returns
            returns = (sum(one.facts) if run.has_seat_returns else one.reward for one in rollout.episodes)
            expected = [(total, length) for total, (_, length) in zip(returns, expected, strict=True)]
        got = [(episode.reward, episode.length) for episode in rollout.episodes]  # `validate` has checked their number
        if not _same(expected, got) and _same(sorted(expected), sorted(got)):
            lengths = [length for _, length in expected]
            raise Broken(
                Rule.EPISODE_ORDER,
                f"episodes of sequence {rollout.sequence} of the lengths {lengths}, in the order of their last steps",
                f"{[length for _, length in got]}",
            )
        for (total, length), episode in zip(expected, rollout.episodes, strict=True):
            if episode.length != length:
                raise Broken(
                    Rule.EPISODES, f"length {length}, as the rows of sequence {rollout.sequence} say", f"{episode.length}"
                )
            if not is_return(episode.reward, total):
                expected_return = f"return {total:g}, the sum of the rewards of its {length} steps"
                raise Broken(Rule.EPISODES, expected_return, f"{episode.reward:g}")

    def _check_log_prob(self, rollout: Rollout, weights: Weights) -> None:
        # If a seat was waiting when the rollout began, older weights may have chosen the action in its first row.
        known = rollout.valid & (rollout.valid.cumsum(0) > 1) if self._run.takes_turns else rollout.valid
        params = params_of(self._run, weights, [leaf[:-1][known][None] for leaf in rollout.obs])
        action = rollout.action[known]
        got = rollout.log_prob[known]
        expected = distribution(self._run.policy).log_prob(params, action[None])[0]
        apart = np.abs(expected - got)
        if (apart > LOG_PROB_TOLERANCE * np.maximum(1.0, np.abs(expected))).any():
            k = int(apart.argmax())
            rounded = weights.parameters.dtype != np.float32
            normalized = self._run.policy.normalize_observations
            place = place_of(np.argwhere(known)[k], self._run.row_axes)
            raise Broken(
                Rule.ROUNDED if rounded else Rule.NORMALIZED if normalized else Rule.LOG_PROB,
                f"log_prob {expected[k]:.5f} at {place} (within {LOG_PROB_TOLERANCE:g}), for action {action[k].tolist()} "
                f"under version {rollout.version}",
                f"{got[k]:.5f}",
            )


def can_be_recomputed(run: RunSpec) -> bool:
    """Whether the numpy policy can recompute what this run's policy does."""
    return run.policy.own is None and not run.policy.needs_torch


def params_of(run: RunSpec, weights: Weights, obs: Sequence[Array]) -> Floats:
    """The distribution's parameters [L, N, P] for these observations [L, N, *leaf], under these weights."""
    policy = make_policy(run.policy)
    policy.load(to_float32(weights.parameters), weights.buffers)
    return policy(obs)


def is_return(got: float, total: float) -> bool:
    """Whether the return `got` equals the sum of rewards `total`, within the tolerance."""
    return abs(got - total) <= RETURN_TOLERANCE * max(1.0, abs(total))


def _same(one: list[tuple[float, int]], other: list[tuple[float, int]]) -> bool:
    """Whether two lists of (return, length) are equal, with returns within the tolerance."""
    return all(a == b and is_return(y, x) for (x, a), (y, b) in zip(one, other, strict=True))
