"""The learner's record of a lane's past, accumulated from its rollouts. Pure.

Rule: a history is a fold over a lane's rollouts in round order, whoever collected them. It keeps only what a worker needs to
continue where the rollouts end (`protocol/lane_past.py`): how the newest episode of each copy began, and the actions since.
An episode cannot be replayed if it is longer than the limit, or if it isn't known how it began. If the lane is lost, a copy
with such an episode starts afresh.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from msgspec import structs

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.lane_past import AttributeChanges, EpisodeBegin, LanePast, LastEpisode
from millrace.protocol.rollout import Rollout


@dataclass(frozen=True, slots=True)
class _OfRound:
    """The rows of one rollout."""

    first: int
    """the index of the first row, counted since the history began"""
    action: Array
    """[T, N · A, *action] the actions"""
    attributes: bytes
    """the attributes that were set on the copies, packed"""


@dataclass
class LaneHistory:
    """The past of one lane, which grows with each rollout. The lane has N env copies with A seats each."""

    copies: list[LastEpisode]
    """[N] the newest episode of each copy; rows are counted since the history began"""
    most_steps: int
    """episodes with more steps than this are not replayed"""
    rows: deque[_OfRound] = field(default_factory=deque)
    """the rows since the beginning of the earliest episode that can be replayed"""
    count: int = 0
    """the number of rows since the history began"""
    obs: tuple[Array, ...] = ()
    """[N · A, *leaf] each: the observations after the last row, then the masks if there are any"""
    memory: tuple[Array, ...] = ()
    too_long: dict[int, int] = field(default_factory=dict)
    """for each copy whose running episode has become too long to be replayed, the index of the episode's first row"""
    no_rows: Array = field(default_factory=lambda: np.zeros(0, np.float32))
    """[0, N · A, *action] an empty array with the shape and dtype of actions"""

    def copy(self) -> LaneHistory:
        """An independent copy of this history."""
        return replace(self, copies=list(self.copies), rows=self.rows.copy(), too_long=dict(self.too_long))

    def add(self, rollout: Rollout, attributes: bytes) -> Bools:
        """Add the next rollout of the lane. Returns [N], True for copies that had started afresh when the rollout began.

        `attributes` are the packed attributes of the rollout's env copies.
        """
        T = len(rollout.action)
        began = {each.copy: each for each in rollout.begun}
        resets = rollout.steps_that_reset
        before = self.copies
        self.copies = [self._after(last, began.get(n), resets[:, n], T) for n, last in enumerate(before)]
        action = np.array(rollout.action)
        self.rows.append(_OfRound(self.count, action, attributes))
        self.no_rows = action[:0]
        self.count += T
        mask = () if rollout.mask is None else (rollout.mask,)
        self.obs = tuple(np.array(leaf[-1]) for leaf in (*rollout.obs, *mask))
        self.memory = tuple(np.array(each) for each in rollout.memory)
        for n in rollout.saved:
            self._saved(n)
        self._forget_long_ones(known=bool(rollout.memory))
        return np.array([new.start != old.start for new, old in zip(self.copies, before, strict=True)])

    def forget(self) -> None:
        """Mark all running episodes as not replayable, because it isn't known what the copies did after the last row."""
        self.copies = [LastEpisode(last.start, None, self.count, False) for last in self.copies]
        self.rows.clear()

    def start_anew(self, attempts: int, *, from_past: bool = True) -> None:
        """Let all copies start afresh after this many failed attempts to continue. No start number is used twice.

        `from_past` says whether one of these attempts began from this history. If so, only some of the copies started afresh
        in that attempt.
        """
        tried = [last.start + (from_past and not last.goes_on) for last in self.copies]  # the start numbers of that attempt
        self.copies = [LastEpisode(number + attempts - 1, None, self.count, False) for number in tried]
        self.rows.clear()

    def past(self, lane: int) -> LanePast:
        """The past that a worker needs to continue the lane."""
        action = np.concatenate([self.no_rows, *(rows.action for rows in self.rows)])
        start = self.rows[0].first if self.rows else self.count
        return LanePast(
            lane=lane,
            copies=tuple(self._shifted(last, start) for last in self.copies),
            action=action,
            attributes=AttributeChanges.of(_changes(self.rows, start)),
            obs=self.obs,
            memory=self.memory,
        )

    @classmethod
    def of(cls, past: LanePast, most_steps: int) -> LaneHistory:
        """The history of a lane from its past in a checkpoint. `most_steps` is the limit of the resumed run."""
        found = cls(
            list(past.copies),
            most_steps,
            count=len(past.action),
            obs=past.obs,
            memory=past.memory,
            no_rows=past.action[:0],
        )
        changes = {0: b""} | past.attributes.by_row()
        for (row, attributes), end in zip(changes.items(), [*list(changes)[1:], len(past.action)], strict=True):
            if row < end:
                found.rows.append(_OfRound(row, past.action[row:end], attributes))
        found._forget_long_ones(known=True)
        return found

    @classmethod
    def of_nothing(cls, copies: int, most_steps: int) -> LaneHistory:
        """The history of a lane without rollouts, whose copies have not started."""
        return cls([LastEpisode(0, b"", 0, False)] * copies, most_steps)

    def _after(self, last: LastEpisode, began: EpisodeBegin | None, resets: Bools, T: int) -> LastEpisode:
        """The newest episode of a copy after T more rows. `resets` [T+1] is True for rows that only reset it."""
        start = last.start if began is None else max(last.start, began.start)  # so that no start number is used twice
        random = None if began is None else began.random
        if resets[T]:
            return LastEpisode(start, random, self.count + T, True)
        if resets.any() or began is not None:
            first = int(np.flatnonzero(resets)[-1]) + 1 if resets.any() else 0
            return LastEpisode(start, random, self.count + first, False, steps=T - first)
        steps = last.steps + T
        # The rows before a saved state were dropped. Unless a newer state was saved, the episode can't be continued.
        if last.saved:
            return LastEpisode(start, None, self.count, False, steps=steps)
        return structs.replace(last, steps=steps)

    def _saved(self, n: int) -> None:
        """Record that the rows of copy n aren't needed, because `memory` has its state after the last row."""
        last = self.copies[n]
        self.copies[n] = structs.replace(last, first=self.count, saved=True)

    @property
    def longest_given_up(self) -> int:
        """The length, in steps, of the longest running episode that is too long to be replayed; 0 if there is none."""
        return max((self.count - first for first in self.too_long.values()), default=0)

    def _forget_long_ones(self, *, known: bool) -> None:
        """Mark episodes that won't be replayed, and keep only the rows of the others.

        `known` says whether workers can continue the lane at all.
        """
        for n, last in enumerate(self.copies):
            if last.goes_on:
                self.too_long.pop(n, None)
            if last.goes_on and (not known or self.count - last.first > self.most_steps):
                if known and self.most_steps >= 0:
                    self.too_long[n] = last.first
                self.copies[n] = LastEpisode(last.start, None, self.count, False, steps=last.steps)
        first_row = min((_needed_from(last) for last in self.copies if last.goes_on), default=self.count)
        while self.rows and self.rows[0].first + len(self.rows[0].action) <= first_row:
            self.rows.popleft()

    def _shifted(self, last: LastEpisode, start: int) -> LastEpisode:
        first = last.first - start if last.goes_on else 0
        return structs.replace(last, first=first)


def _needed_from(last: LastEpisode) -> int:
    """The first row needed to replay an episode. It is the row of the reset, because the attributes at that time matter."""
    return last.first - 1 if last.random and last.is_repeated else last.first


def _changes(kept: Iterable[_OfRound], start: int) -> dict[int, bytes]:
    """The new attributes at each row where they change, by row, counted from `start`."""
    found: dict[int, bytes] = {}
    before = b""
    for rows in kept:
        if rows.attributes != before:
            before = found[rows.first - start] = rows.attributes
    return found


@dataclass(frozen=True)
class LaneHistories:
    """The settings of lane histories, and the pasts with which a resumed run begins."""

    copies: int = 1
    """N, the number of env copies of a lane"""
    most_steps: int = -1
    """episodes with more steps than this are not replayed; -1 if none are replayed"""
    pasts: Sequence[LanePast] = ()
    """the pasts of lanes, from a checkpoint"""

    def of(self, lane: int) -> LaneHistory | None:
        """The history of a lane when the run is resumed; None if the lane has no rollouts yet.

        If the number of copies has changed, no episode continues.
        """
        past = next((past for past in self.pasts if past.lane == lane), None)
        if past is None:
            return None
        if len(past.copies) == self.copies:
            return LaneHistory.of(past, self.most_steps)
        newest = max(last.start for last in past.copies)
        return LaneHistory([LastEpisode(newest, None, 0, False)] * self.copies, self.most_steps)

    def begin(self) -> LaneHistory:
        """The history of a lane without rollouts."""
        return LaneHistory.of_nothing(self.copies, self.most_steps)
