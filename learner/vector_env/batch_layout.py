"""The layout of a batch: which rows belong to each lane and env copy. Pure.

Row n of every array of a batch belongs to env copy n. With A seats, copy n has the rows n · A to n · A + A - 1. The rows of
a lane are consecutive, and lane 0 comes first.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from itertools import accumulate

from millrace.protocol.envs.seats import columns_of


class BatchLayout:
    """Which rows and env copies belong to each lane."""

    def __init__(self, lane_sizes: Sequence[int], seats: int = 1) -> None:
        """`lane_sizes` has the number of env copies of each lane. `seats` is A, the number of seats of each copy."""
        ends = list(accumulate(lane_sizes))
        self._seats = seats
        self.count = ends[-1]
        """The number of env copies."""
        self.lanes = range(len(ends))
        self._copies = [range(end - size, end) for end, size in zip(ends, lane_sizes, strict=True)]
        self._firsts = [copies.start for copies in self._copies]
        self.rows = [slice(copies.start * seats, copies.stop * seats) for copies in self._copies]
        """The rows of each lane, in lane order."""

    def copies(self, lane: int) -> range:
        """The env copies of a lane, numbered as in the whole batch."""
        return self._copies[lane]

    def copies_of(self, lanes: Iterable[int]) -> list[int]:
        """The env copies of these lanes."""
        return [n for lane in lanes for n in self.copies(lane)]

    def rows_of(self, copies: Sequence[int]) -> Sequence[int]:
        """The rows of these env copies."""
        return columns_of(copies, self._seats)

    def size(self, lane: int) -> int:
        """Number of env copies of a lane."""
        return len(self.copies(lane))

    def lane_of(self, copy: int) -> int:
        """The lane of an env copy. Raises `IndexError` if there is no such copy."""
        if not 0 <= copy < self.count:
            raise IndexError(f"copy: expected 0 to {self.count - 1}, got {copy}")
        return bisect_right(self._firsts, copy) - 1

    def by_lane(self, copies: Iterable[int]) -> dict[int, list[int]]:
        """Group env copies by lane, in the given order. In the result, copies are numbered within their lane, from 0."""
        grouped: dict[int, list[int]] = {}
        for copy in copies:
            lane = self.lane_of(copy)
            grouped.setdefault(lane, []).append(copy - self._firsts[lane])
        return grouped

    def check(self, copies: Sequence[int]) -> None:
        """Raise `ValueError` unless there is at least one copy, and all are different and exist."""
        if not copies or len(set(copies)) != len(copies) or not 0 <= min(copies) <= max(copies) < self.count:
            raise ValueError(f"env_ids: expected different numbers from 0 to {self.count - 1}, got {list(copies)}")

    def positions(self, copies: Sequence[int]) -> dict[int, Sequence[int]]:
        """The positions of each lane's rows among the rows of `copies`, by lane.

        Raises `ValueError` unless `copies` consists of whole lanes.
        """
        self.check(copies)
        at = {copy: position for position, copy in enumerate(copies)}
        positions_of = {lane: [at.get(copy, -1) for copy in self.copies(lane)] for lane in self.by_lane(sorted(copies))}
        for lane, positions in positions_of.items():
            if -1 in positions:
                of_lane = self.copies(lane)
                raise ValueError(
                    f"env_ids: expected all copies of lane {lane}, {of_lane[0]} to {of_lane[-1]}, got "
                    f"{[copy for copy in of_lane if copy in at]}; with lanes=num_envs every copy is a lane of its own"
                )
        return {lane: self.rows_of(positions) for lane, positions in positions_of.items()}
