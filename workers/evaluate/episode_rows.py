"""Sends the rows of the episodes of one evaluation, in messages of bounded size.

Rule: a message contains consecutive rows of one episode. It is sent when it reaches `CHUNK_BYTES`, or the episode ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import MOST_FRAMES
from millrace.protocol.messages import EpisodeRows, Evaluate

CHUNK_BYTES = 8 * 2**20

SendRows = Callable[[EpisodeRows], None]


class RowsOfEpisode(NamedTuple):
    """L consecutive rows of one episode. With seats, each observation and each action has an entry for each seat."""

    obs: tuple[Array, ...]
    """[L, *leaf] each: the observations that follow the actions"""
    action: Array
    """[L, *action]"""
    reward: Array
    """[L] float64"""
    terminated: Array
    truncated: Array
    """[L] bool each"""

    def part(self, begin: int, end: int) -> RowsOfEpisode:
        """A copy of some of these rows."""
        obs = tuple(leaf[begin:end].copy() for leaf in self.obs)
        return RowsOfEpisode(obs, *(array[begin:end].copy() for array in self[1:]))


class RowSender:
    """Gathers the rows of one episode, and sends them."""

    def __init__(self, order: Evaluate, episode: int, send: SendRows) -> None:
        """`episode` is the index of the episode's seed in the order."""
        self.episode = episode
        self._order = order
        self._send = send
        self._first_step = 0
        self._before: tuple[Array, ...] = ()  # [1, *leaf] each: the observation before the first of these rows
        self._rows: list[RowsOfEpisode] = []
        self._frames: list[Array] = []
        self._frames_so_far = 0
        self._bytes = 0

    @property
    def wants_frame(self) -> bool:
        """Whether `show` should be called with the frame of the next observation, before that observation is added."""
        return self._order.send_frames and self._frames_so_far < MOST_FRAMES

    def show(self, frame: Array) -> None:
        """Add the frame of the next observation. Raises `ValueError` if its size differs from that of the frame
        before it.
        """
        if self._frames and frame.shape != self._frames[-1].shape:
            before = list(self._frames[-1].shape)
            now = list(frame.shape)
            raise ValueError(f"render: expected frames of one size, {before} as before, got {now}")
        self._frames.append(frame)
        self._frames_so_far += 1
        self._bytes += frame.nbytes

    def begin(self, obs: Sequence[Array]) -> None:
        """Add the first observation of the episode. Its arrays [1, *leaf] are copied."""
        self._before = tuple(leaf.copy() for leaf in obs)
        self._bytes += sum(leaf.nbytes for leaf in obs)

    def add(self, rows: RowsOfEpisode) -> None:
        """Add copies of these rows. While frames are wanted, add one row at a time."""
        was_last_frame = bool(self._frames) and self._frames_so_far == MOST_FRAMES
        ends = was_last_frame or bool(rows.terminated[-1] or rows.truncated[-1])
        L = len(rows.reward)
        bytes_of_row = (sum(leaf.nbytes for leaf in rows.obs) + rows.action.nbytes) // L + 10
        at = 0
        while at < L:
            room = math.ceil((CHUNK_BYTES - self._bytes) / bytes_of_row)  # rows until the message is full
            end = min(L, at + max(1, room))
            self._rows.append(rows.part(at, end))
            self._bytes += (end - at) * bytes_of_row
            at = end
            if self._bytes >= CHUNK_BYTES or (ends and at == L):
                self._flush()  # rule ROWS_FIRST

    def _flush(self) -> None:
        order = self._order
        of_leaves, actions, *numbers = zip(*self._rows, strict=True)
        reward, terminated, truncated = map(np.concatenate, numbers)
        obs = tuple(np.concatenate(parts) for parts in zip(self._before, *of_leaves, strict=True))
        has_frames = len(self._frames) == len(reward) + 1
        self._send(
            EpisodeRows(  # rule EPISODE_ROWS
                session=order.session,
                ticket=order.ticket,
                episode=self.episode,
                first_step=self._first_step,
                obs=obs,
                action=np.concatenate(actions),
                reward=reward,
                terminated=terminated,
                truncated=truncated,
                frames=np.stack(self._frames) if has_frames else None,
            )
        )
        self._first_step += len(reward)
        self._before = tuple(leaf[-1:] for leaf in obs)
        self._rows = []
        self._bytes = 0
        self._frames = self._frames[-1:] if self._frames_so_far < MOST_FRAMES else []


def as_frame(rendered: Any) -> Array:
    """A copy of a rendered frame [H, W, 3] uint8. Raises `ValueError` for anything else."""
    frame = np.asarray(rendered)
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size:
        raise ValueError(f"render: expected an array [H, W, 3] of uint8, got {frame.dtype}{list(frame.shape)}")
    return frame.copy()  # an environment may draw the next frame into the same array
