"""Checks the arrays of `EpisodeRows`: consecutive rows of a played episode. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import MOST_FRAMES
from millrace.protocol.messages import EpisodeRows
from millrace.protocol.rows.array_checks import Expected, wrong_arrays, wrong_observation
from millrace.protocol.specs import RunSpec


def reason_to_reject(
    rows: EpisodeRows, before: Sequence[EpisodeRows], run: RunSpec, most_steps: int, with_frames: bool
) -> str:
    """What is wrong with these rows; empty if they can be used. `before` has the earlier rows of the same episode."""
    policy = run.policy
    seats = (len(run.seats),) if run.seats else ()
    if before and (before[-1].terminated[-1] or before[-1].truncated[-1]):
        return "expected none after the end of their episode"
    L = len(rows.reward) if rows.reward.ndim == 1 else 0
    if not 1 <= L <= most_steps - rows.first_step:
        return f"expected 1 to {most_steps - rows.first_step} rows, got reward {list(rows.reward.shape)}"
    action = policy.action
    expected = [
        Expected("action", rows.action, (L, *seats, *action.shape), action.stored_dtype, action),
        Expected("reward", rows.reward, (L,), "float64"),
        Expected("terminated", rows.terminated, (L,), "bool"),
        Expected("truncated", rows.truncated, (L,), "bool"),
    ]
    axes = ("row", "seat") if seats else ("row",)
    if why := wrong_observation(rows.obs, policy.observation, (L + 1, *seats), axes) or wrong_arrays(expected, axes):
        return why
    if (rows.terminated | rows.truncated)[:-1].any():
        return "expected an end only in the last row"
    return _wrong_frames(rows.frames, rows.first_step + L + 1, L, [one.frames for one in before[:1]], with_frames)


def _wrong_frames(frames: Array | None, end: int, L: int, first: Sequence[Array | None], wanted: bool) -> str:
    """What is wrong with the frames of L rows.

    `end` is how many observations the episode has up to the end of these rows. `first` has the frames of the episode's first
    rows, and is empty if these are the first.
    """
    if frames is None:
        return "frames: expected those of the first observations" if wanted and not first else ""
    if not wanted or end > MOST_FRAMES:
        return f"frames: expected {f'those of the first {MOST_FRAMES} observations' if wanted else 'none'}"
    size = list(frames.shape[1:3])
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[::3] != (L + 1, 3) or not all(size):
        return f"frames: expected uint8[{L + 1}, H, W, 3], got {frames.dtype}{list(frames.shape)}"
    for before in first:
        if before is None or before.shape[1:3] != frames.shape[1:3]:
            return f"frames: expected the size of the first ones, got {size}"
    return ""
