"""Assembles whole episodes from the rows of rollouts. Pure: arrays in, arrays out.

Rule: every valid row is in exactly one whole episode, or waits for its episode to end (`waiting`), or is counted as left out
    (`left_out`). A reset row is not part of an episode. No episode has a gap: if it spans several rollouts, it is assembled
    only if all of them arrived, in order, and each continues the previous one. (An incarnation's first rollout may continue
    an earlier rollout, which another worker collected or which precedes a resume; `fresh` tells in which env copies it
    doesn't. A client that owns its loop takes steps between two rollouts, so the second rollout doesn't continue the first,
    and its first row isn't valid.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.rollout import Rollout


@dataclass(frozen=True)
class RecordedEpisode:
    """An episode of L steps, from a reset to its end. The last of its L+1 observations is the result of the last step."""

    obs: tuple[Array, ...]  # [L+1, *leaf] for each leaf of the observation
    action: tuple[Array, ...]  # [L, *part] for each part of the action, as the environment took it
    reward: Array  # [L] raw rewards
    terminated: Bools  # [L]
    truncated: Bools  # [L]
    seed: int | None = None
    """seed of the reset that began the episode, if it is known"""

    @property
    def length(self) -> int:
        """Number of steps."""
        return len(self.reward)

    @property
    def episode_return(self) -> float:
        """Undiscounted sum of raw rewards."""
        return float(np.sum(self.reward, dtype=np.float64))


class _Fragment(NamedTuple):
    """The k rows of an episode that are in one rollout. They are copies, so that the rollout's arrays can be freed."""

    obs: tuple[Array, ...]  # [k, *leaf] each; [k+1, *leaf] in the last fragment of an episode
    action: tuple[Array, ...]  # [k, *part] each
    reward: Array
    terminated: Bools
    truncated: Bools  # [k] each


@dataclass
class _LaneState:
    """The unfinished episodes of a lane."""

    incarnation: int
    sequence: int  # sequence number of the next rollout
    running: list[list[_Fragment] | None] = field(default_factory=list)
    """[N] the unfinished episode of each env copy; None until it ends if its beginning is missing"""
    last_obs: tuple[Array, ...] = ()  # the last observations of the newest rollout, [N, *leaf] each
    ended: Bools = field(default_factory=lambda: np.zeros(0, bool))  # [N] whether an episode ended in its last row

    @property
    def waiting(self) -> int:
        return sum(len(fragment.reward) for fragments in self.running for fragment in fragments or ())

    def continued_by(self, rollout: Rollout, fresh: Bools | bool) -> Bools:
        """[N] whether the rollout continues the newest one in each env copy.

        It does if three conditions hold: the copy isn't `fresh`, its first observation is the newest rollout's last one, and
        it begins with a reset row exactly when that rollout ended an episode.
        """
        continued: Bools = (rollout.valid[0] != self.ended) & np.logical_not(fresh)
        for last, leaf in zip(self.last_obs, rollout.obs, strict=True):
            continued &= (last == leaf[0]).reshape(len(last), -1).all(1)
        return continued


class EpisodeAssembler:
    """Assembles the episodes of many lanes."""

    def __init__(self, to_env_action: Callable[[Array], tuple[Array, ...]]) -> None:
        """`to_env_action` converts actions of rollouts, [k, *action], to the arrays [k, *part] that environments take."""
        self.left_out = 0
        """number of valid rows in episodes that stay incomplete, because rows are missing or an env copy started afresh"""
        self._to_env_action = to_env_action
        self._lanes: dict[int, _LaneState] = {}

    @property
    def waiting(self) -> int:
        """Number of valid rows in episodes that have not ended."""
        return sum(lane.waiting for lane in self._lanes.values())

    def add(self, rollout: Rollout, incarnation: int, fresh: Bools | bool) -> list[RecordedEpisode]:
        """The episodes that end in this rollout, in the order in which they end.

        `incarnation`: the incarnation of the lane when the rollout was collected. `fresh`: [N], or a single value for all
        env copies, True for copies that don't continue the lane's previous rollout.
        """
        lane = self._lanes.get(rollout.lane)
        if lane is not None and (incarnation, rollout.sequence) < (lane.incarnation, lane.sequence):
            self.left_out += rollout.env_steps  # the rollout arrived out of order
            return []
        # In its first rollout, a fresh copy begins with a step, and any other copy with a reset row or within an episode.
        begins = (rollout.valid[0] == fresh) & (rollout.sequence == 0)
        new: list[list[_Fragment] | None] = [[] if one else None for one in begins.tolist()]
        follows = lane is not None and (incarnation, rollout.sequence) == (lane.incarnation, lane.sequence)
        if lane is None or not (follows or rollout.sequence == 0):  # a rollout in between was dropped
            self.left_out += lane.waiting if lane is not None else 0
            lane = self._lanes[rollout.lane] = _LaneState(incarnation, rollout.sequence, new)
        else:  # another worker may have continued the lane, with all of its copies or only some
            waiting = lane.waiting
            continued = lane.continued_by(rollout, fresh)
            running = [one if continued[n] else new[n] for n, one in enumerate(lane.running)]
            lane = self._lanes[rollout.lane] = _LaneState(incarnation, rollout.sequence, running)
            self.left_out += waiting - lane.waiting
        ends = [end for n in range(len(lane.running)) for end in self._column(rollout, lane, n)]
        lane.sequence += 1
        lane.last_obs = tuple(leaf[-1].copy() for leaf in rollout.obs)
        lane.ended = rollout.terminated[-1] | rollout.truncated[-1]
        return [episode for _, episode in sorted(ends, key=lambda end: end[0])]

    def _column(self, rollout: Rollout, lane: _LaneState, n: int) -> list[tuple[int, RecordedEpisode]]:
        """The episodes of env copy `n` that end in this rollout, each with the step at which it ends."""
        done = []
        start = 0
        steps = len(rollout.reward)
        valid = rollout.valid[:, n]
        ended = rollout.terminated[:, n] | rollout.truncated[:, n]
        for t in np.flatnonzero(ended | ~valid).tolist():
            if not valid[
                t
            ]:  # the next row begins an episode, unless t is 0: then `running[n]` already says whether one begins
                lane.running[n] = [] if t else lane.running[n]
                start = t + 1
                continue
            fragments = lane.running[n]
            if fragments is None:
                self.left_out += t + 1 - start
            else:
                done.append((t, _joined([*fragments, self._fragment(rollout, n, start, t + 1, last=True)])))
            lane.running[n] = []
            start = t + 1
        if start < steps:
            fragments = lane.running[n]
            if fragments is None:
                self.left_out += steps - start
            else:
                fragments.append(self._fragment(rollout, n, start, steps))
        return done

    def _fragment(self, rollout: Rollout, n: int, start: int, end: int, last: bool = False) -> _Fragment:
        return _Fragment(
            obs=tuple(leaf[start : end + last, n].copy() for leaf in rollout.obs),
            action=tuple(np.array(part) for part in self._to_env_action(rollout.action[start:end, n])),
            reward=rollout.reward[start:end, n].copy(),
            terminated=rollout.terminated[start:end, n].copy(),
            truncated=rollout.truncated[start:end, n].copy(),
        )


def _joined(fragments: list[_Fragment]) -> RecordedEpisode:
    obs, action, reward, terminated, truncated = zip(*fragments, strict=True)
    return RecordedEpisode(
        obs=tuple(np.concatenate(leaf) for leaf in zip(*obs, strict=True)),
        action=tuple(np.concatenate(part) for part in zip(*action, strict=True)),
        reward=np.concatenate(reward),
        terminated=np.concatenate(terminated),
        truncated=np.concatenate(truncated),
    )
