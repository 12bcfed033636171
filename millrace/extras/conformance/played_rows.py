"""Checks an evaluation: its rows must match each other and the answer, and its actions must match the weights. Pure.

It recomputes everything that a learner can recompute: the most probable actions, with the numpy policy, and the returns and
lengths of episodes, from their rows.
"""

from __future__ import annotations

import numpy as np

from millrace.extras.conformance.lane_rows import LOG_PROB_TOLERANCE, can_be_recomputed, is_return, params_of
from millrace.extras.conformance.script import Broken, brief
from millrace.protocol.arrays import Array
from millrace.protocol.messages import EpisodeRows, Evaluate, Evaluated, Weights
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.rows.played import reason_to_reject
from millrace.protocol.rules import Rule
from millrace.protocol.specs import RunSpec

BY_CHANCE = -14.0  # if log P(every sampled action is the most probable one) exceeds this, that may be chance


class PlayedRows:
    """One answer to an Evaluate: the rows of its episodes, then its Evaluated."""

    def __init__(self, order: Evaluate, run: RunSpec, weights: Weights) -> None:
        """`weights`: the weights of the version that the order names."""
        self.ended = False
        """whether the Evaluated has arrived"""
        self.rows: list[list[EpisodeRows]] = [[] for _ in order.seeds]
        """the rows that have arrived, for each episode"""
        self._order = order
        self._run = run
        self._weights = weights

    def see_rows(self, rows: EpisodeRows) -> None:
        """Check the next rows of an episode. Raises `Broken` if they break a rule."""
        order = self._order
        if not (order.send_rows or order.send_frames):
            raise Broken(Rule.ROWS_FIRST, "no rows: the order does not ask for them", brief(rows))
        if rows.episode >= len(self.rows):
            raise Broken(Rule.EPISODE_ROWS, f"an episode below {len(self.rows)}", f"episode {rows.episode}")
        before = self.rows[rows.episode]
        if rows.first_step != (at := sum(len(some.reward) for some in before)):
            raise Broken(Rule.ROWS_FIRST, f"rows of episode {rows.episode} from step {at}", f"from step {rows.first_step}")
        if why := reason_to_reject(rows, before, self._run, order.most_steps, order.send_frames):
            raise Broken(Rule.EPISODE_ROWS, "rows as in the table", why)
        for one, other in zip(before[-1].obs if before else (), rows.obs, strict=bool(before)):
            if one[-1].tobytes() != other[0].tobytes():
                expected = f"obs[0] to be the last observation of the rows of episode {rows.episode} before"
                raise Broken(Rule.EPISODE_ROWS, expected, "another observation")
        before.append(rows)

    def see_answer(self, answer: Evaluated) -> None:
        """Check the Evaluated, which ends the answer. Raises `Broken` if the answer breaks a rule."""
        order = self._order
        k = len(self.rows)
        if not len(answer.episodes) == len(answer.cut) == k:
            raise Broken(Rule.EVALUATE, f"{k} episodes for {k} seeds", f"{len(answer.episodes)}")
        for n, (episode, cut) in enumerate(zip(answer.episodes, answer.cut, strict=True)):
            if episode.length > order.most_steps or (cut and episode.length != order.most_steps):
                expected = f"a cut after {order.most_steps} steps (most_steps), or an end before"
                raise Broken(Rule.CUT, expected, f"{episode.length} steps")
            if order.send_rows:
                self._check_episode(n, episode.length, episode.reward, cut)
        if order.send_rows and can_be_recomputed(self._run) and not self._run.seats:  # rows don't say which seats act
            self._check_actions()
        self.ended = True

    def _check_episode(self, n: int, length: int, total: float, cut: bool) -> None:
        rows = self.rows[n]
        if (got := sum(len(some.reward) for some in rows)) != length:
            raise Broken(
                Rule.ROWS_FIRST, f"{length} rows of episode {n} before Evaluated (send_rows is true)", f"{got} rows"
            )
        last = rows[-1]
        if not (last.terminated[-1] or last.truncated[-1]):
            expected = f"terminated or truncated in the last row of episode {n}, {'which was cut' if cut else 'its end'}"
            raise Broken(Rule.EPISODE_ROWS, expected, "neither")
        if cut and last.terminated[-1]:
            raise Broken(Rule.CUT, f"no cut of episode {n}, which terminated at most_steps", "cut")
        if not self._run.seats and not is_return(total, summed := float(sum(some.reward.sum() for some in rows))):
            raise Broken(
                Rule.EPISODES, f"return {summed:g} of episode {n}, the sum of the rewards of its rows", f"{total:g}"
            )

    def _check_actions(self) -> None:
        every = [some for rows in self.rows for some in rows]
        best, lost, is_best = (np.concatenate(each) for each in zip(*map(self._against_the_best, every), strict=True))
        version = self._order.version
        if self._order.greedy and (wrong := lost > LOG_PROB_TOLERANCE * np.maximum(1.0, np.abs(best))).any():
            expected = f"the most probable actions under version {version} (greedy is true)"
            raise Broken(Rule.GREEDY, expected, f"others in {int(wrong.sum())} of {wrong.size} rows")
        by_chance = not self._run.policy.action.numbers and best.sum() > BY_CHANCE
        if not self._order.greedy and is_best.all() and not by_chance:
            raise Broken(
                Rule.GREEDY, "drawn actions (greedy is false)", f"the most probable one in each of {lost.size} rows"
            )

    def _against_the_best(self, rows: EpisodeRows) -> tuple[Array, Array, Array]:
        """Three values for each row: the log-probability of the most probable action, how far the chosen action's is below
        it, and whether the chosen action is the most probable one.
        """
        params = params_of(self._run, self._weights, [leaf[:-1, None] for leaf in rows.obs])
        policy = distribution(self._run.policy)
        action = rows.action[:, None]
        mode = policy.mode(params)
        best = policy.log_prob(params, mode)[:, 0]
        log_prob = policy.log_prob(params, action)[:, 0]
        return best, best - log_prob, np.isclose(action, mode).reshape(len(action), -1).min(-1)

    def first_observation(self, n: int) -> bytes:
        """The bytes of the first observation of episode `n`, whose rows must have arrived."""
        return b"".join(leaf[0].tobytes() for leaf in self.rows[n][0].obs)
