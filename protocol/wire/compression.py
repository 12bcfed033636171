"""How an array of a rollout travels when it is not as it lies. Pure: bytes in, bytes out; it comes back bit for bit.

A packing has a name; the head lists those of an array in the order in which they were done. `zstd` is a Zstandard frame (RFC
8878) that says how much it holds. `stack` is for frame stacks as gymnasium's FrameStackObservation makes them, uint8
[T+1, N, k, H, W, …]: what step t+1 shows is mostly what step t showed, moved on by a frame, of which only the newest is new.
Its payload is

    bits     [N, T]        1: step t+1 of copy n is step t moved on by a frame; lowest bit first, zeros up to a whole byte
    frames   [M, H, W, …]  copy by copy and step by step: the newest of a step that is moved on, all k of every other

so that a step shows the last k frames up to its own, whether sent for it or before. Whatever a peer says is checked before
anything is set aside for it: a stack is at most k times as large as its payload, and what a Zstandard frame holds must be
as much as the array needs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from protocol.arrays import Array, Bools, Bytes
from protocol.errors import BadMessage

Frame = bytes | memoryview

MAX_STACK = 16
LEAST_FRAME_BYTES = 64  # below, an index of the frames would be larger than they are
WORTH = 0.25  # of a stack's bytes must be saved
ZSTD_LEVEL = -1  # of images it saves as much as higher levels do; of what cannot be compressed it lets go at once
ZSTD_FROM_BYTES = 1024  # what is smaller costs more than it saves
ZSTD_WORTH = 0.1  # of an array's bytes must be saved
PROBES = 8  # steps that are looked at before all are
COMPARED_WORDS = 1 << 15  # at once: what is compared should be in the cache still


@dataclass(frozen=True)
class Packing:
    """What a sender may do with the arrays of a rollout."""

    stack: bool = False
    """frames that are seen several times are sent once"""
    zstd: bool = False
    """what is worth it is compressed"""

    def of(self, array: Array) -> tuple[Frame, list[str]]:
        """The array's frame and the names of its packings: none, if it goes as it lies."""
        frame: Frame = raw_bytes(array)
        packings: list[str] = []
        if self.stack and (payload := pack_stack(array)) is not None:
            frame, packings = payload.data, ["stack"]
        if self.zstd and (compressed := _compressed(frame)) is not None:
            frame, packings = compressed, [*packings, "zstd"]
        return frame, packings


def raw_bytes(array: Array) -> memoryview:
    """Its bytes, without a copy if they are C-ordered."""
    return array.ravel().view(np.uint8).data


def unpack_array(frame: Frame, packings: Sequence[object], dtype: np.dtype[Any], shape: Sequence[int]) -> Array:
    """The array, read-only, that this frame stands for; it may be as large as it says. Raises `BadMessage`."""
    size = dtype.itemsize * math.prod(shape)
    match packings:
        case ["stack"]:
            return unpack_stack(frame, dtype, shape)
        case ["zstd"]:
            return np.ndarray(shape, dtype, _decompressed(frame, size, size))
        case ["stack", "zstd"]:
            return unpack_stack(_decompressed(frame, 0, size + size // LEAST_FRAME_BYTES), dtype, shape)
        case _:
            raise BadMessage(f"packings expected stack, zstd or both in this order, got {str(packings)[:80]}")


def why_no_zstd() -> str:
    """Why nothing can be compressed or decompressed here; empty if it can."""
    try:
        import zstandard  # noqa: F401  (an extra)
    except ImportError:
        return "compress zstd needs the package zstandard, which is an extra; pip install 'millrace-rl[compress]'"
    return ""


def _compressed(frame: Frame) -> bytes | None:
    """A Zstandard frame; None where too little would be saved."""
    if len(frame) < ZSTD_FROM_BYTES:
        return None
    import zstandard

    found = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(frame)
    return found if len(found) <= (1 - ZSTD_WORTH) * len(frame) else None


def _decompressed(frame: Frame, least: int, most: int) -> bytes:
    """What a Zstandard frame holds, if it says that it is between `least` and `most` bytes. Raises `BadMessage`."""
    try:
        import zstandard
    except ImportError:
        raise BadMessage("zstd was not asked for, and cannot be read here") from None
    try:
        held = zstandard.frame_content_size(frame)  # -1: it does not say
        if not least <= held <= most:
            raise BadMessage(f"zstd expected a frame that says it holds {least} to {most} bytes, got {held}")
        return zstandard.ZstdDecompressor().decompress(frame, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise BadMessage(f"zstd: {' '.join(str(error).split())[:200]}") from error


def pack_stack(array: Array) -> Bytes | None:
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


def unpack_stack(payload: Frame, dtype: np.dtype[Any], shape: Sequence[int]) -> Array:
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
