"""How an array of a rollout travels when it is not as it lies. Pure: bytes in, bytes out; it comes back bit for bit.

A packing has a name; the head lists those of an array in the order in which they were done. `stack` is for frame stacks as
gymnasium's FrameStackObservation makes them, uint8 [T+1, N, k, H, W, …]: what step t+1 shows is mostly what step t showed,
moved on by a frame, of which only the newest is new. The payload is

    bits     [N, T]        1: step t+1 of copy n is step t moved on by a frame; lowest bit first, zeros up to a whole byte
    frames   [M, H, W, …]  copy by copy and step by step: the newest of a step that is moved on, all k of every other

so that a step shows the last k frames up to its own, whether sent for it or before. Whatever a peer says is checked
before anything is set aside for it; an array is at most k times as large as the frames it is made from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.errors import BadMessage

Array = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]
Frame = bytes | memoryview

MAX_STACK = 16
LEAST_FRAME_BYTES = 64  # below, an index of the frames would be larger than they are
WORTH = 0.25  # of an array's bytes must be saved
PROBES = 8  # steps that are looked at before all are
COMPARED_WORDS = 1 << 15  # at once: what is compared should be in the cache still


@dataclass(frozen=True)
class Packing:
    """What a sender may do with the arrays of a rollout."""

    stack: bool = False
    """frames that are seen several times are sent once"""

    def of(self, array: Array) -> tuple[Frame, list[str]]:
        """The array's frame and the names of its packings: none, if it goes as it lies."""
        if self.stack and (payload := stacked(array)) is not None:
            return payload.data, ["stack"]
        return as_it_lies(array), []


def as_it_lies(array: Array) -> memoryview:
    """Its bytes, without a copy if they are C-ordered."""
    return array.ravel().view(np.uint8).data


def unpacked(frame: Frame, packings: Sequence[object], dtype: np.dtype[Any], shape: Sequence[int]) -> Array:
    """The array, read-only, that this frame stands for; it may be as large as it says. Raises `BadMessage`."""
    match packings:
        case ["stack"]:
            return unstacked(frame, dtype, shape)
        case _:
            raise BadMessage(f"packings expected stack, got {str(packings)[:80]}")


def stacked(array: Array) -> Bytes | None:
    """The payload of a frame stack; None where that is not what the array is, or too little would be saved."""
    if not _may_be_stack(array.dtype, array.shape):
        return None
    steps, copies, k = array.shape[:3]
    frames = np.ascontiguousarray(array).reshape(steps, copies, k, -1)  # [T+1, N, k, F]
    moved = _moved(frames)
    if moved is None:
        return None
    sent = np.ones((copies, steps, k), bool)
    sent[:, 1:, :-1] = ~moved[:, :, None]
    chosen = np.arange(steps * copies * k).reshape(steps, copies, k).swapaxes(0, 1)[sent]  # [M]
    bits = np.packbits(moved, bitorder="little")
    payload = np.empty(bits.size + chosen.size * frames.shape[-1], np.uint8)
    payload[: bits.size] = bits
    out = payload[bits.size :].reshape(chosen.size, -1)
    np.take(frames.reshape(-1, frames.shape[-1]), chosen, axis=0, out=out, mode="clip")  # not "raise": that copies once more
    return payload


def unstacked(payload: Frame, dtype: np.dtype[Any], shape: Sequence[int]) -> Array:
    """The frame stack, read-only, that the payload stands for. Raises `BadMessage`."""
    if not _may_be_stack(dtype, shape):
        expected = f"uint8 [T+1, N, 2 to {MAX_STACK}, H, W, …] with frames of {LEAST_FRAME_BYTES} bytes or more"
        raise BadMessage(f"stack expected {expected}, got {dtype.str}{list(shape)}")
    steps, copies, k = shape[:3]
    frame_bytes, bit_count = math.prod(shape[3:]), copies * (steps - 1)
    bit_bytes = (bit_count + 7) // 8
    fewest = bit_bytes + copies * (steps - 1 + k) * frame_bytes
    if len(payload) < fewest:
        raise BadMessage(f"stack {list(shape)} expected at least {fewest} bytes, got {len(payload)}")
    told = np.frombuffer(payload, np.uint8)
    bits = np.unpackbits(told[:bit_bytes], bitorder="little")
    if bits[bit_count:].any():
        raise BadMessage(f"stack {list(shape)} expected {bit_count} bits and then zeros, got others")
    moved = bits[:bit_count].reshape(copies, steps - 1).view(bool)
    frame_count = copies * steps * k - (k - 1) * int(np.count_nonzero(moved))
    total = bit_bytes + frame_count * frame_bytes
    if len(payload) != total:
        raise BadMessage(f"stack {list(shape)} expected {total} bytes by its bits, got {len(payload)}")
    sent = np.full((copies, steps), k)
    sent[:, 1:] -= (k - 1) * moved
    last = sent.cumsum().reshape(copies, steps) - 1
    shown = last.T[:, :, None] + np.arange(1 - k, 1)  # [T+1, N, k] which frame is seen there
    array = told[bit_bytes:].reshape(frame_count, frame_bytes).take(shown, axis=0).reshape(shape)
    array.flags.writeable = False
    return array


def _may_be_stack(dtype: np.dtype[Any], shape: Sequence[int]) -> bool:
    if not (dtype == np.uint8 and len(shape) >= 5 and shape[0] > 1 and shape[1] > 0 and 2 <= shape[2] <= MAX_STACK):
        return False
    return math.prod(shape[3:]) >= LEAST_FRAME_BYTES


def _moved(frames: Bytes) -> Bools | None:
    """[N, T] whether each step is the one before, moved on by a frame; None if too few are for it to be worth while."""
    steps, copies, k, size = frames.shape
    words = frames.view(next(f"u{width}" for width in (8, 4, 2, 1) if size % width == 0))
    fewest = WORTH * steps * k / (k - 1)  # for each copy

    def same(before: Array, after: Array) -> Bools:
        return np.asarray((before[:, :, 1:] == after[:, :, :-1]).reshape(len(after), copies, -1).all(-1))

    probes = np.arange(0, steps - 1, -(-steps // PROBES))
    if np.count_nonzero(same(words[probes], words[probes + 1])) < probes.size * copies * fewest / steps:
        return None
    moved = np.empty((steps - 1, copies), bool)
    chunk = max(1, COMPARED_WORDS // words[0].size)
    for t in range(0, steps - 1, chunk):
        end = min(steps - 1, t + chunk)
        moved[t:end] = same(words[t:end], words[t + 1 : end + 1])
    return moved.T if np.count_nonzero(moved) >= fewest * copies else None
