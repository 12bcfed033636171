"""The env copies of one lane of a vector environment with seats. They have N · A rows; the rows of one copy are adjacent.

Rule: rows are, bit for bit, those of a loop over the same copies (`millrace.protocol.envs.seats`). With SameStep, the step
in which a copy's last agent leaves returns the last rows of the episode, but with the first observations of the next
episode; the final observations are in the infos.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from millrace.protocol.arrays import Array
from millrace.protocol.envs.seats import SeatStep, columns_of, side_by_side
from millrace.workers.copies.env_loop import CopyInfos
from millrace.workers.copies.row_writers import read_leaves, write_numbers
from millrace.workers.vector_env.stepped_lane import SteppedLane


class SeatedLane(SteppedLane):
    """N env copies with A seats each, which are stepped together."""

    def _of_each(self, actions: Sequence[Array]) -> Iterable[Any]:
        of_copies = [array.reshape(-1, len(self._seats), *array.shape[1:]) for array in actions]
        if not self._nested_actions:
            return of_copies[0]
        return [list(map(self._nest, zip(*of_seats, strict=True))) for of_seats in zip(*of_copies, strict=True)]

    def _write(self, infos: CopyInfos) -> CopyInfos:
        newest, leaves = self._newest(range(self.count), infos)
        self._writer.write(self._joined, 0, leaves)
        rows = self.rows
        numbers = newest.reward, newest.terminated, newest.truncated
        write_numbers((rows.reward, rows.terminated, rows.truncated), slice(None), numbers)
        return [(row, dict(info)) for row, info in enumerate(newest.infos) if info]

    def _write_some(self, copies: Sequence[int], infos: CopyInfos) -> CopyInfos:
        newest, leaves = self._newest(copies, infos)
        numbers = list(columns_of(copies, len(self._seats)))
        self._writer.write_some(self.rows.obs, numbers, [dict(zip(numbers, values, strict=True)) for values in leaves])
        for array in (self.rows.reward, self.rows.terminated, self.rows.truncated):
            array[numbers] = 0
        return [(row, dict(info)) for row, info in zip(numbers, newest.infos, strict=True) if info]

    def _newest(self, copies: Iterable[int], infos: CopyInfos) -> tuple[SeatStep, Sequence[Any]]:
        """The newest steps of these copies as one `SeatStep`, and the leaves to write for them."""
        last = {n: info["final_obs"] for n, info in infos}  # last steps of copies that SameStep has reset
        steps: list[SeatStep] = [self._observations[n] for n in copies]
        newest = side_by_side(_reset(last[n], step) if n in last else step for n, step in zip(copies, steps, strict=True))
        seen = newest.observations
        leaves = read_leaves(self._read, seen, self._seats) if self._nested_observations else (seen,)
        return newest, (*leaves, newest.acts, newest.complete, newest.outside)


def _reset(last: SeatStep, first: SeatStep) -> SeatStep:
    """Combine the step that ended an episode (`last`) with the reset by which SameStep began the next one (`first`)."""
    infos: list[Mapping[str, Any]] = [
        {"final_obs": seen, "final_info": info, **new}
        for seen, info, new in zip(last.observations, last.infos, first.infos, strict=True)
    ]
    outside = [old + new for old, new in zip(last.outside, first.outside, strict=True)]
    return last._replace(observations=first.observations, infos=infos, acts=first.acts, outside=outside)
