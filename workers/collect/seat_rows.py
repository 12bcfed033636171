"""The rows of a lane whose env copies have seats: which are valid, and what a seat did that waits for its outcome.

Rule: a seat's row is the one in which its outcome comes (`millrace.protocol.envs.seats`). Until then each row repeats what
was written when the seat acted: action, log-probability, and the state of the policy before it. So the row is whole wherever
rollouts are cut, and a rollout may hold an action that older weights chose, with its log-probability under those.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.protocol.arrays import Array, Bools, Doubles, Floats
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.rollout import Episode
from millrace.protocol.rows.rollout_checks import LARGEST_REWARD
from millrace.protocol.specs import RunSpec
from millrace.workers.copies.env_copies import SeatColumns, StepResult
from millrace.workers.copies.value_checks import check_rewards
from millrace.workers.lanes.running_episodes import RunningEpisodes
from millrace.workers.opponents import Match, Opponent, OtherTeams


class SeatRows:
    """What a lane of N copies with A seats each keeps from step to step, and the rows of the present rollout."""

    def __init__(self, run: RunSpec, lane: int, incarnation: int, running: RunningEpisodes) -> None:
        self._run, self._seats = run, run.seats_of_copy
        self._lane, self._incarnation = lane, incarnation
        self.others: OtherTeams | None = None
        """those of other teams, once the first episodes have begun, if the policy plays one team alone"""
        self._opponent: Opponent | None = None  # in the episodes that begin in this rollout
        columns = run.columns
        self.acts: Bools
        """[N · A] whether the next step takes the seat's action"""
        self._waits = np.zeros(columns, bool)  # [N · A] it has acted, and its row is not complete
        self._held: list[Array] = []  # what the policy wrote when each seat acted last
        self._held_state = zero_state(run.policy, columns)  # [N · A, S] before that
        self._resets = np.zeros(run.copies, bool)  # [N] the next step only resets the copy
        self._running = running

    def start(self, first: SeatColumns) -> None:
        """All copies were reset."""
        self.acts = first.acts
        self._add_outside(first.outside, 0)

    def begin(self, state: Floats, opponent: Opponent | None) -> Floats:
        """A rollout begins, with the policy in this state [N · A, S]. Returns the state before the first rows.

        `opponent`: in the episodes that begin in it.
        """
        T, run = self._run.rollout_steps, self._run
        self._opponent = opponent
        if opponent is not None and self.others is None:
            matches = [Match(run.team_of(self._lane, n), opponent) for n in range(run.copies)]
            drawn = generator(run.seed, Purpose.OPPONENTS, self._lane, self._incarnation)
            self.others = OtherTeams(run, matches, drawn)
        self.valid = np.zeros((T, run.columns), bool)
        self.resets = np.zeros((T + 1, run.copies), bool)
        self.resets[0] = self._resets
        self._episodes: list[Episode] = []
        return np.where(self._waits[:, None], self._held_state, state)

    def acted(self, t: int, written: Sequence[Array], before: Floats, state: Floats) -> None:
        """The policy has written its row t for all columns, and was in the state `before`. Only some seats act."""
        if not self._held:
            self._held = [np.zeros_like(array[0]) for array in written]
        for array, held in zip(written, self._held, strict=True):
            held[self.acts] = array[t][self.acts]
            array[t] = held
        self._held_state[self.acts] = before[self.acts]
        state[~self.acts] = before[~self.acts]
        self._waits |= self.acts

    def stepped(self, t: int, row: StepResult, state: Floats, now_s: float) -> None:
        """Step t has returned this. Sets the policy's state to zeros where an episode begins."""
        assert row.columns is not None
        complete, self.acts, outside, over = row.columns
        self.valid[t] = complete
        self._waits &= ~complete
        self._running.add(np.asarray(row.reward, np.float64).reshape(-1, self._seats), ~self._resets)
        if np.count_nonzero(outside):
            self._add_outside(outside, t)
        state[np.repeat(self._resets, self._seats)] = 0.0
        if self.others is not None and self._opponent is not None:
            self.others.begin(np.flatnonzero(self._resets).tolist(), self._opponent)
        self.resets[t + 1] = self._resets = over
        for n in np.flatnonzero(over).tolist():
            self._episodes.append(self._running.ended(n, now_s, row.facts.get(n), self.others).episode)

    def _add_outside(self, outside: Doubles, t: int) -> None:
        """Add rewards [N · A] of step t that are in no row to the returns. No later check sees them."""
        if not np.abs(outside).max() < LARGEST_REWARD:  # false for NaN too
            check_rewards(self._lane, outside[None], self._run.row_axes, t)
        self._running.returns += outside.reshape(-1, self._seats)

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """Those that ended in this rollout, ordered by step, then by copy."""
        return tuple(self._episodes)
