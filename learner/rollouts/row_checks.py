"""Checks of the rows of played episodes, which a worker sent. Pure."""

from __future__ import annotations

import numpy as np

from protocol.arrays import Array
from protocol.messages import EpisodeRows
from protocol.specs import PolicySpec


def reason_to_reject(rows: EpisodeRows, policy: PolicySpec, most_steps: int) -> str:
    """What is wrong with these rows; empty if they can be used."""
    L = len(rows.reward) if rows.reward.ndim == 1 else 0
    if not 1 <= L <= most_steps - rows.first_step:
        return f"expected 1 to {most_steps - rows.first_step} rows, got reward {list(rows.reward.shape)}"
    if len(rows.obs) != len(policy.observation):
        return f"observation: expected {len(policy.observation)} arrays, got {len(rows.obs)}"
    action = policy.action
    expected: list[tuple[str, Array, tuple[int, ...], str]] = [
        ("action", rows.action, (L, *action.shape), action.stored_dtype),
        ("reward", rows.reward, (L,), "float64"),
        ("terminated", rows.terminated, (L,), "bool"),
        ("truncated", rows.truncated, (L,), "bool"),
    ]
    for array, leaf in zip(rows.obs, policy.observation, strict=True):
        expected.append((f"observation {leaf.path}".strip(), array, (L + 1, *leaf.shape), leaf.dtype))
    for name, array, shape, dtype in expected:
        if array.shape != shape or array.dtype != np.dtype(dtype):
            return f"{name}: expected {dtype}{list(shape)}, got {array.dtype}{list(array.shape)}"
    if not np.isfinite(rows.reward).all() or (rows.terminated | rows.truncated)[:-1].any():
        return "expected finite rewards, and an end only in the last row"
    frames = rows.frames
    if frames is not None and (frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[::3] != (L + 1, 3)):
        return f"frames: expected uint8[{L + 1}, H, W, 3], got {frames.dtype}{list(frames.shape)}"
    return ""
