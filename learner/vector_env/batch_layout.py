"""Layout of a batch: the rows of each lane. Pure.

Row n of every array of a batch belongs to env copy n. A lane has consecutive rows; lane 0 has the first ones.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from itertools import accumulate


class BatchLayout:
    """The rows of each lane."""

    def __init__(self, lane_sizes: Sequence[int]) -> None:
        """`lane_sizes`: the number of env copies of each lane."""
        ends = list(accumulate(lane_sizes))
        self.num_envs = ends[-1]
        self.lanes = range(len(ends))
        self.rows = [slice(end - size, end) for end, size in zip(ends, lane_sizes, strict=True)]
        """Rows of each lane, by lane."""
        self._firsts = [rows.start for rows in self.rows]
        self._copies = [range(rows.start, rows.stop) for rows in self.rows]

    def copies(self, lane: int) -> range:
        """The env copies of a lane, numbered as in the whole batch."""
        return self._copies[lane]

    def copies_of(self, lanes: Iterable[int]) -> list[int]:
        """The env copies of these lanes."""
        return [n for lane in lanes for n in self.copies(lane)]

    def size(self, lane: int) -> int:
        """Number of env copies of a lane."""
        return len(self.copies(lane))

    def lane_of(self, copy: int) -> int:
        """The lane of an env copy. Raises `IndexError` if there is no such copy."""
        if not 0 <= copy < self.num_envs:
            raise IndexError(f"copy: expected 0 to {self.num_envs - 1}, got {copy}")
        return bisect_right(self._firsts, copy) - 1

    def by_lane(self, copies: Iterable[int]) -> dict[int, list[int]]:
        """Env copies grouped by lane. Within a lane they are numbered from 0, in the given order."""
        grouped: dict[int, list[int]] = {}
        for copy in copies:
            lane = self.lane_of(copy)
            grouped.setdefault(lane, []).append(copy - self._firsts[lane])
        return grouped

    def check(self, copies: Sequence[int]) -> None:
        """Raises `ValueError` unless these are different copies that exist, at least one."""
        if not copies or len(set(copies)) != len(copies) or not 0 <= min(copies) <= max(copies) < self.num_envs:
            raise ValueError(f"env_ids: expected different numbers from 0 to {self.num_envs - 1}, got {list(copies)}")

    def positions(self, copies: Sequence[int]) -> dict[int, list[int]]:
        """Where in `copies` the copies of each lane are, by lane. Raises `ValueError` unless all are whole lanes."""
        self.check(copies)
        at = {copy: position for position, copy in enumerate(copies)}
        found = {lane: [at.get(copy, -1) for copy in self.copies(lane)] for lane in self.by_lane(sorted(copies))}
        for lane, positions in found.items():
            if -1 in positions:
                of_lane = self.copies(lane)
                raise ValueError(
                    f"env_ids: expected all copies of lane {lane}, {of_lane[0]} to {of_lane[-1]}, got "
                    f"{[copy for copy in of_lane if copy in at]}; with lanes=num_envs every copy is a lane of its own"
                )
        return found
