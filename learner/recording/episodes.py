"""Rows -> whole episodes, to be kept. Pure: arrays in, arrays out.

The law: every valid row that is given is in exactly one whole episode, or waits for its episode to end (`waiting`), or is
counted as left out (`left_out`); a reset row is in none. An episode that goes over several rollouts is put together only
where all of them came, in order, from one life (incarnation) of their lane: there are no holes in an episode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from protocol.arrays import Array, Bools
from protocol.rollout import Rollout


@dataclass(frozen=True)
class RecordedEpisode:
    """L steps from a reset to an end. The last of its L+1 observations is the one that the last step led to."""

    obs: tuple[Array, ...]  # [L+1, *leaf] for each leaf of the observation
    action: Array  # [L, *action] as the environment took it
    reward: Array  # [L] raw
    terminated: Bools  # [L]
    truncated: Bools  # [L]
    seed: int | None = None
    """of the reset it began with, where that is known"""

    @property
    def length(self) -> int:
        """Steps."""
        return len(self.reward)

    @property
    def total(self) -> float:
        """The return: undiscounted sum of raw rewards."""
        return float(np.sum(self.reward, dtype=np.float64))


class _Piece(NamedTuple):
    """The rows of an episode that one rollout holds, copied: a rollout's own arrays are let go."""

    obs: tuple[Array, ...]  # [k, *leaf] each; [k+1, *leaf] of the piece with which the episode ends
    action: Array  # [k, *action]
    reward: Array
    terminated: Bools
    truncated: Bools  # [k] each


@dataclass
class _Lane:
    """Where a lane stands."""

    incarnation: int
    sequence: int  # of the rollout that must come next
    open: list[list[_Piece] | None] = field(default_factory=list)
    """[N] the running episode of each copy so far; None where its beginning is not there, until the copy resets"""

    @property
    def waiting(self) -> int:
        return sum(len(piece.reward) for pieces in self.open for piece in pieces or ())


class EpisodeAssembler:
    """Puts the episodes of many lanes together. `taken` converts stored actions to those of the environment."""

    def __init__(self, taken: Callable[[Array], Array]) -> None:
        self.left_out = 0
        """valid rows of episodes that cannot be whole: one of their rollouts was dropped, or their lane moved"""
        self._taken = taken
        self._lanes: dict[int, _Lane] = {}

    @property
    def waiting(self) -> int:
        """Valid rows of episodes that have not ended."""
        return sum(lane.waiting for lane in self._lanes.values())

    def add(self, rollout: Rollout, incarnation: int) -> list[RecordedEpisode]:
        """The episodes that this rollout ends, oldest first. `incarnation`: of the lane, when this rollout was collected."""
        lane = self._lanes.get(rollout.lane)
        if lane is not None and (incarnation, rollout.sequence) < (lane.incarnation, lane.sequence):
            self.left_out += rollout.env_steps  # it comes out of order
            return []
        if lane is None or (incarnation, rollout.sequence) != (lane.incarnation, lane.sequence):
            self.left_out += lane.waiting if lane is not None else 0
            begins = rollout.sequence == 0
            lane = _Lane(incarnation, rollout.sequence, [[] if begins else None for _ in range(rollout.reward.shape[1])])
            self._lanes[rollout.lane] = lane
        lane.sequence += 1
        ended = [end for n in range(len(lane.open)) for end in self._column(rollout, lane, n)]
        return [episode for _, episode in sorted(ended, key=lambda end: end[0])]

    def _column(self, rollout: Rollout, lane: _Lane, n: int) -> list[tuple[int, RecordedEpisode]]:
        """Copy `n`: its episodes that end here, and at which step."""
        done = []
        start, steps = 0, len(rollout.reward)
        valid, ended = rollout.valid[:, n], rollout.terminated[:, n] | rollout.truncated[:, n]
        for t in np.flatnonzero(ended | ~valid).tolist():
            if not valid[t]:  # a reset: the next row begins an episode
                self.left_out += sum(len(piece.reward) for piece in lane.open[n] or ())  # its copy was lost before it ended
                lane.open[n], start = [], t + 1
                continue
            pieces = lane.open[n]
            if pieces is None:
                self.left_out += t + 1 - start
            else:
                done.append((t, _joined([*pieces, self._piece(rollout, n, start, t + 1, last=True)])))
            lane.open[n], start = [], t + 1
        if start < steps:
            pieces = lane.open[n]
            if pieces is None:
                self.left_out += steps - start
            else:
                pieces.append(self._piece(rollout, n, start, steps))
        return done

    def _piece(self, rollout: Rollout, n: int, start: int, end: int, last: bool = False) -> _Piece:
        return _Piece(
            obs=tuple(leaf[start : end + last, n].copy() for leaf in rollout.obs),
            action=np.array(self._taken(rollout.action[start:end, n])),
            reward=rollout.reward[start:end, n].copy(),
            terminated=rollout.terminated[start:end, n].copy(),
            truncated=rollout.truncated[start:end, n].copy(),
        )


def _joined(pieces: list[_Piece]) -> RecordedEpisode:
    obs, action, reward, terminated, truncated = zip(*pieces, strict=True)
    return RecordedEpisode(
        obs=tuple(np.concatenate(leaf) for leaf in zip(*obs, strict=True)),
        action=np.concatenate(action),
        reward=np.concatenate(reward),
        terminated=np.concatenate(terminated),
        truncated=np.concatenate(truncated),
    )
