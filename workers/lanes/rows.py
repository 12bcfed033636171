"""The rows of lanes that are stepped together, while they are being written.

Rule: a step fills one row of every lane. When all rows are filled, they follow the row format (`protocol/rollout.py`), and
the running episodes of each lane include all its rows. Rows stay empty only at the end of an evaluation, when all its
episodes are over. If a copy was not stepped, its part of the row repeats the copy's last observation and has no reward.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.policy.masks import stored_leaves
from millrace.protocol.specs import RunSpec
from millrace.workers.activity import ENV_CALLS, activity
from millrace.workers.copies.env_copies import EvaluationCopies, SeatColumns, StepResult
from millrace.workers.copies.env_errors import CopyFailed, environment_failed
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.row_writers import write_numbers
from millrace.workers.copies.seated_copies import SeatedCopies
from millrace.workers.lanes.lane import Lane
from millrace.workers.lanes.running_episodes import EndedEpisode
from millrace.workers.lanes.seats import Seats


class EpisodesLost(Exception):
    """Copies were lost with their worker, and so were episodes of an evaluation."""


class Rows:
    """T rows of L lanes. N · A is the number of columns of each lane."""

    def __init__(self, run: RunSpec, lanes: Sequence[Lane], steps: int) -> None:
        """T is `steps`. The first observations and the states come from the lanes."""
        L = len(lanes)
        T = steps
        columns = lanes[0].columns
        shape = (L, T, columns)
        self.steps = steps
        self.first_step = 0
        """the number of the first row's step in error messages"""
        self.obs = tuple(np.empty((L, T + 1, columns, *leaf.shape), leaf.dtype) for leaf in stored_leaves(run))
        """[L, T+1, N · A, *leaf] each; in a masked run the last one is the mask"""
        self.state: Floats = np.array([lane.state for lane in lanes])
        """[L, N · A, S] recurrent state of the policy, updated at each step"""
        self.reward = np.empty(shape)
        """[L, T, N · A] float64, so that returns are summed before they are rounded"""
        self.terminated = np.empty(shape, bool)
        self.truncated = np.empty(shape, bool)
        """[L, T, N · A] each"""
        self.resets = np.zeros((L, T + 1, lanes[0].count), bool)
        """[L, T+1, N] whether step t belongs to no episode: it only resets the copy, or leaves it as it is"""
        self.step_end_s: list[float] = []
        """[T] when each step ended, in seconds of `perf_counter`"""
        self.of_lanes = [RowsOfLane(run, self, i, lane) for i, lane in enumerate(lanes)]
        self.numbers = [lane.number for lane in lanes if lane.number is not None]
        """numbers of the lanes; none in an evaluation"""
        self._calls = activity().numbers
        self._calls_before_row = 0

    @property
    def filled(self) -> int:
        """How many rows are complete."""
        return len(self.step_end_s)

    @property
    def are_over(self) -> bool:
        """Whether no further step will be made, because these rows are of an evaluation whose episodes have all ended."""
        return not any(each.lane.autoresets or np.count_nonzero(each.lane.playing) for each in self.of_lanes)

    def begin_row(self) -> None:
        """Begin the next row; the one before is complete."""
        self._calls_before_row = self._calls[ENV_CALLS]

    def begin_again(self) -> None:
        """Begin the next rows, which follow these rows and reuse their arrays."""
        self.first_step += self.steps
        self.step_end_s.clear()
        for array in self.obs:
            array[:, 0] = array[:, -1]
        for each in self.of_lanes:
            each.begin()

    def env_steps(self) -> int:
        """Env steps made, including those of an incomplete row.

        The count never falls, and includes only calls to the environment that have returned.
        """
        before = self._of_rows(self.filled)
        if self.filled == self.steps:
            return before
        after = self._of_rows(self.filled + 1)
        # Calls in this row that have returned. Assume that the first of them were resets, so that the count never falls.
        calls = self._calls[ENV_CALLS] - self._calls_before_row
        resets = sum(each.lane.count for each in self.of_lanes) - (after - before)
        return min(after, before + max(0, calls - resets))

    def _of_rows(self, rows: int) -> int:
        """Env steps in this many rows. Even before a row is made, it is known which copies it only resets."""
        return sum(rows * each.lane.count - each.resets_in(rows) for each in self.of_lanes)


class RowsOfLane:
    """The part of the rows that belongs to one lane."""

    def __init__(self, run: RunSpec, rows: Rows, i: int, lane: Lane) -> None:
        """`i`: index of the lane."""
        self.lane = lane
        self.obs = tuple(array[i] for array in rows.obs)
        self.state = rows.state[i]
        self.reward = rows.reward[i]
        self.terminated = rows.terminated[i]
        self.truncated = rows.truncated[i]
        self.resets = rows.resets[i]
        self.valid: Bools = np.zeros(self.reward.shape, bool)
        """[T, N · A]"""
        self.ended: list[EndedEpisode] = []
        """the episodes that ended, ordered by step, then by copy"""
        self.columns: SeatColumns | None = None
        """columns of the newest step; None without seats"""
        self._rows = rows
        self._seats = run.seats_of_copy
        self._numbers = (self.reward, self.terminated, self.truncated)
        self._nothing_outside = np.zeros(lane.columns)
        self._joined = lane.writer.joined(self.obs)
        self._facts: dict[tuple[int, int], tuple[float, ...]] = {}  # facts of episodes that ended, by row and copy
        for array, newest in zip(self.obs, lane.obs, strict=True):
            array[0] = newest
        self.begin()

    def begin(self) -> None:
        """Start over: no row has been written."""
        self.resets[0] = ~self.lane.playing  # rules FIRST_VALID, FIRST_RESETS
        self.ended.clear()
        self._facts.clear()

    def pass_on(self) -> None:  # rule CONTINUES
        """Store in the lane the state that its next rows begin with."""
        self.lane.obs = tuple(array[-1].copy() for array in self.obs)
        self.lane.state = self.state.copy()

    def resets_in(self, rows: int) -> int:
        """How many steps of copies in the first `rows` rows belong to no episode."""
        if self.lane.seats is not None or not self.lane.autoresets:
            return int(np.count_nonzero(self.resets[:rows]))
        if not rows:
            return 0
        ended = self.terminated[: rows - 1] | self.truncated[: rows - 1]  # [rows - 1, N]
        return int(np.count_nonzero(self.resets[0]) + np.count_nonzero(ended))

    def acted(self, t: int, written: Sequence[Array], before: Floats, taken: Array) -> None:
        """With seats, keep what the policy wrote at step t only for seats that act, and let the opponents act.

        `before` is the policy's state before this step. `taken` are the actions [N · A, *action] for the environment.
        """
        lane = self.lane
        assert lane.seats is not None
        if lane.others is not None:
            lane.others.act([leaf[t] for leaf in self.obs], lane.seats.acts, taken)
        lane.seats.acted(t, written, before, self.state)

    def step(self, t: int, actions: Array, pulse: Pulse) -> None:
        """Step the copies with actions [N · A, *action], and write what they return."""
        lane = self.lane
        try:
            result = lane.copies.step(actions, pulse) if lane.autoresets else self._step_playing(actions, pulse)
            # rules ROWS, LAST_OBSERVATION
            write_numbers(self._numbers, t, (result.reward, result.terminated, result.truncated))
            lane.writer.write(self._joined, t + 1, result.leaves)
            self.columns = result.columns
        except CopyFailed as error:
            raise environment_failed(lane.number, error, f"step {self._rows.first_step + t}") from error
        if result.facts:
            for n, of_copy in result.facts.items():
                self._facts[t, n] = of_copy
        if result.lost is not None:
            self._lose(t, result.lost)
        if not lane.autoresets:
            self._show_playing(t)

    def _step_playing(self, actions: Array, pulse: Pulse) -> StepResult:
        """Step the copies whose episodes continue. Returns the result without copies that the lane doesn't use."""
        lane = self.lane
        copies: EvaluationCopies = lane.copies  # type: ignore[assignment]
        playing = lane.playing.nonzero()[0].tolist()
        if len(playing) == copies.count:
            return copies.step(actions, pulse, playing)
        result = copies.step(actions[lane.playing.repeat(self._seats)], pulse, playing)
        return result if lane.count == copies.count else result.first(lane.count, lane.columns)

    def _show_playing(self, t: int) -> None:
        """Remove rewards and ends from row t for copies that were not stepped, because the row repeats their last step.

        Nothing is learned from these rows, so they also contain rewards that belong to no row of a seat.
        """
        playing = self.lane.playing
        if self.columns is not None:
            self.reward[t] += self.columns.outside
            self.columns = self.columns._replace(outside=self._nothing_outside, over=self.columns.over & playing)
        if np.count_nonzero(playing) < len(playing):
            still = (~playing).repeat(self._seats)
            for array in self._numbers:
                array[t][still] = 0  # half the time of `array[t, still] = 0`
            if self.columns is not None:
                self.columns.complete[still] = False

    def _lose(self, t: int, lost: Bools) -> None:
        """Some copies were lost in step `t` (`lost` [N]). Truncate their episodes at the last step that was made.

        Rows `t` and `t + 1` are then not valid, because step `t` was not made. In an evaluation, raises `EpisodesLost`,
        because its episodes must be complete.
        """
        if not self.lane.autoresets:
            if (lost & self.lane.playing).any():
                raise EpisodesLost
            return
        self.truncated[t] |= lost
        if t:
            self.truncated[t - 1] |= lost & ~self.terminated[t - 1]
        else:
            self.resets[0] |= lost  # the episode's last row is in a rollout that was already sent, so no rollout has its end

    def count(self, t: int, now_s: float) -> None:
        """Add row t to the running episodes."""
        lane = self.lane
        if lane.seats is None:
            self.valid[t] = lane.playing
            over = self.terminated[t] | self.truncated[t]
        else:
            over = self._count_seats(t, lane.seats)
        lane.episodes.add(self.reward[t].reshape(-1, self._seats), lane.playing)
        for n in (ended := over.nonzero()[0].tolist()):
            self.ended.append(lane.episodes.ended(n, now_s, self._facts.get((t, n)), lane.others))
        if lane.autoresets:
            lane.playing = ~over
        elif ended:
            lane.playing = lane.playing & ~over
        if self._rows.first_step + t + 1 >= lane.episodes.most_steps:
            self._cut(t, now_s)
        self.resets[t + 1] = ~lane.playing

    def _count_seats(self, t: int, seats: Seats) -> Bools:  # rule SEATS
        """Count row t for seats.

        Returns whether the episode of each copy [N] is over. Where an episode begins, the policy's state is set to zeros,
        and the opponent may change.
        """
        lane = self.lane
        columns = self.columns
        assert columns is not None
        self.valid[t] = columns.complete
        seats.stepped(columns)
        if np.count_nonzero(columns.outside):
            lane.add_outside(columns.outside, self._rows.first_step + t)
        if lane.autoresets:
            begins = ~lane.playing
            self.state[np.repeat(begins, self._seats)] = 0.0
            if lane.others is not None and lane.opponent is not None:
                lane.others.begin(np.flatnonzero(begins).tolist(), lane.opponent)
        return columns.over

    def count_all(self) -> None:
        """Like `count` for each row, but faster. Only for copies with one agent that are reset by steps."""
        np.logical_or(self.terminated, self.truncated, out=self.resets[1:])
        only_resets = self.resets[:-1]
        self.reward[only_resets] = 0.0
        self.valid = ~only_resets
        self.lane.playing = ~self.resets[-1]
        self.ended += self.lane.episodes.add_rows(self.reward, self.resets, self._rows.step_end_s, self._facts)

    def _cut(self, t: int, now_s: float) -> None:
        """End the episodes that have reached the step limit, at row t.

        Rewards of seats that wait for others are added to the row, because no later step will return them.
        """
        lane = self.lane
        too_long = lane.playing & (lane.episodes.lengths >= lane.episodes.most_steps)
        for n in np.flatnonzero(too_long).tolist():
            if isinstance(lane.copies, SeatedCopies):
                pending = lane.copies.pending(n)
                self.reward[t, n * self._seats : (n + 1) * self._seats] += pending
                lane.episodes.returns[n] += pending
            self.ended.append(lane.episodes.ended(n, now_s, None, lane.others, cut=True))
        lane.playing &= ~too_long
