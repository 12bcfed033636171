"""The rows of the episodes of one evaluation, cut into messages of bounded size.

Rule: a message holds consecutive rows of one episode. It is sent when it has `CHUNK_BYTES`, and when the episode ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import MOST_FRAMES
from millrace.protocol.messages import EpisodeRows, Evaluate
from millrace.protocol.specs import PolicySpec

CHUNK_BYTES = 8 * 2**20

SendRows = Callable[[EpisodeRows], None]


class RowSender:
    """Collects the rows of one episode and sends them."""

    def __init__(self, order: Evaluate, episode: int, policy: PolicySpec, send: SendRows) -> None:
        """`episode` is the index of its seed."""
        self.episode = episode
        self._order = order
        self._policy = policy
        self._send = send
        self._first_step = 0
        self._obs: list[tuple[Array, ...]] = []
        self._frames: list[Array] = []
        self._frames_so_far = 0
        self._rows: list[tuple[Array, float, bool, bool]] = []  # action, reward, terminated, truncated
        self._bytes = 0

    @property
    def wants_frame(self) -> bool:
        """Whether the next observation should come with a frame."""
        return self._order.send_frames and self._frames_so_far < MOST_FRAMES

    def observe(self, leaves: Sequence[Array], frame: Array | None) -> None:
        """Add an observation: its arrays, which are copied, and the rendered frame.

        Raises `ValueError` if the frame's size differs.
        """
        if frame is not None and self._frames and frame.shape != self._frames[-1].shape:
            before = list(self._frames[-1].shape)
            now = list(frame.shape)
            raise ValueError(f"render: expected frames of one size, {before} as before, got {now}")
        self._obs.append(tuple(leaf.copy() for leaf in leaves))
        self._bytes += sum(leaf.nbytes for leaf in leaves)
        if frame is not None:
            self._frames.append(frame)
            self._frames_so_far += 1
            self._bytes += frame.nbytes

    def step(self, action: Array, reward: float, terminated: bool, truncated: bool) -> None:
        """Add a row. The observation after it must have been added."""
        self._rows.append((action.copy(), reward, terminated, truncated))
        self._bytes += action.nbytes + 10
        was_last_frame = bool(self._frames) and self._frames_so_far == MOST_FRAMES
        if terminated or truncated or was_last_frame or self._bytes >= CHUNK_BYTES:
            self._flush()  # rule ROWS_FIRST

    def _flush(self) -> None:
        spec = self._policy
        order = self._order
        actions, rewards, terminated, truncated = zip(*self._rows, strict=True)
        has_frames = len(self._frames) == len(self._obs)
        self._send(
            EpisodeRows(  # rule EPISODE_ROWS
                session=order.session,
                ticket=order.ticket,
                episode=self.episode,
                first_step=self._first_step,
                obs=tuple(np.stack(leaf) for leaf in zip(*self._obs, strict=True)),
                action=np.stack(actions).astype(spec.action.stored_dtype, copy=False),
                reward=np.array(rewards, np.float64),
                terminated=np.array(terminated, bool),
                truncated=np.array(truncated, bool),
                frames=np.stack(self._frames) if has_frames and self._frames else None,
            )
        )
        self._first_step += len(self._rows)
        self._obs = self._obs[-1:]
        self._rows = []
        self._bytes = 0
        self._frames = self._frames[-1:] if self._frames_so_far < MOST_FRAMES else []


def as_frame(rendered: Any) -> Array:
    """A copy of a rendered picture [H, W, 3] uint8. Raises `ValueError` for anything else."""
    frame = np.asarray(rendered)
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size:
        raise ValueError(f"render: expected an array [H, W, 3] of uint8, got {frame.dtype}{list(frame.shape)}")
    return frame.copy()  # an environment may draw the next frame into the same array
