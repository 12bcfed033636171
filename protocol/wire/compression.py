"""Packing (lossless compression) of the arrays of a rollout. Pure: bytes in, bytes out.

A packing has a name. The head lists the packings of an array in the order in which they were applied. `zstd` is a Zstandard
frame (RFC 8878) that declares its content size. `stack` is for frame stacks, as made by gymnasium's FrameStackObservation:
uint8 [T+1, N, k, H, W, …]. In most cases, step t+1 is step t shifted by one frame, and only its newest frame is new. The
payload of a stack is

    bits     [N, T]        1: step t+1 of copy n is step t shifted by one frame; lowest bit first, zeros up to a whole byte
    frames   [M, H, W, …]  by copy, then by step: the newest frame of a shifted step, all k frames of any other step

Each step therefore consists of its own newest frame and the k - 1 frames before it. Sizes from a peer are checked before
memory is allocated: a stack is at most k times as large as its payload, and a Zstandard frame must declare the size that the
array needs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from millrace.protocol.arrays import Array, Bools, Bytes
from millrace.protocol.errors import BadMessage

Frame = bytes | memoryview

MAX_STACK = 16
MIN_FRAME_BYTES = 64  # with smaller frames, an index of the frames would be larger than the frames
MIN_STACK_SAVING = 0.25  # fraction of a stack's bytes that packing must save
ZSTD_LEVEL = -1  # saves as much on images as higher levels, and quickly skips incompressible bytes
MIN_ZSTD_BYTES = 1024  # compressing smaller arrays costs more than it saves
MIN_ZSTD_SAVING = 0.1  # fraction of an array's bytes that compression must save
PROBED_STEPS = 8  # number of steps that are compared first; all steps are compared only if enough of these are shifted
COMPARED_WORDS = 1 << 15  # words per comparison, few enough to stay in the CPU cache


@dataclass(frozen=True)
class Packing:
    """The packings that a sender may apply to the arrays of a rollout."""

    stack: bool = False
    """whether to send each frame of a frame stack only once"""
    zstd: bool = False
    """whether to compress arrays with Zstandard where that saves enough"""

    def pack(self, array: Array) -> tuple[Frame, list[str]]:
        """The array's frame, and the names of its packings; there are no names if its raw bytes are sent."""
        frame: Frame = raw_bytes(array)
        packings: list[str] = []
        if self.stack and (payload := pack_stack(array)) is not None:
            frame = payload.data
            packings = ["stack"]
        if self.zstd and (compressed := _compressed(frame)) is not None:
            frame = compressed
            packings = [*packings, "zstd"]
        return frame, packings


def raw_bytes(array: Array) -> memoryview:
    """The array's bytes in C order; a view if the array is C-ordered already."""
    return array.ravel().view(np.uint8).data


def unpack_array(frame: Frame, packings: Sequence[object], dtype: np.dtype[Any], shape: Sequence[int]) -> Array:
    """Unpack a frame into a read-only array of this dtype and shape. The caller must have checked the size of the array.

    Raises `BadMessage` if the frame can't be unpacked.
    """
    size = dtype.itemsize * math.prod(shape)
    match packings:
        case ["stack"]:
            return unpack_stack(frame, dtype, shape)
        case ["zstd"]:
            return np.ndarray(shape, dtype, _decompressed(frame, size, size))
        case ["stack", "zstd"]:
            return unpack_stack(_decompressed(frame, 0, size + size // MIN_FRAME_BYTES), dtype, shape)
        case _:
            raise BadMessage(f"packings: expected stack, zstd or both in this order, got {str(packings)[:80]}")


def has_zstd() -> bool:
    """Whether the optional package zstandard is installed here."""
    try:
        import zstandard  # noqa: F401
    except ImportError:
        return False
    return True


def _compressed(frame: Frame) -> bytes | None:
    """The bytes as a Zstandard frame; None if that saves too little."""
    if len(frame) < MIN_ZSTD_BYTES:
        return None
    import zstandard

    found = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(frame)
    return found if len(found) <= (1 - MIN_ZSTD_SAVING) * len(frame) else None


def _decompressed(frame: Frame, least: int, most: int) -> bytes:
    """The content of a Zstandard frame. Raises `BadMessage` unless the frame declares a size of `least` to `most` bytes."""
    try:
        import zstandard
    except ImportError:
        raise BadMessage("zstd was not requested, and cannot be read here") from None
    try:
        held = zstandard.frame_content_size(frame)  # -1 if the frame doesn't declare it
        if not least <= held <= most:
            raise BadMessage(f"zstd: expected a frame that declares {least} to {most} bytes, got {held}")
        return zstandard.ZstdDecompressor().decompress(frame, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise BadMessage(f"zstd: {' '.join(str(error).split())[:200]}") from error


def pack_stack(array: Array) -> Bytes | None:
    """The payload of a frame stack; None if the array isn't a frame stack or packing saves too little."""
    if not _may_be_stack(array.dtype, array.shape):
        return None
    steps, copies, k = array.shape[:3]
    frames = np.ascontiguousarray(array).reshape(steps, copies, k, -1)  # [T+1, N, k, F]
    shifted = _find_shifted_steps(frames)
    if shifted is None:
        return None
    sent = np.ones((copies, steps, k), bool)
    sent[:, 1:, :-1] = ~shifted[:, :, None]
    chosen = np.arange(steps * copies * k).reshape(steps, copies, k).swapaxes(0, 1)[sent]  # [M]
    bits = np.packbits(shifted, bitorder="little")
    payload = np.empty(bits.size + chosen.size * frames.shape[-1], np.uint8)
    payload[: bits.size] = bits
    out = payload[bits.size :].reshape(chosen.size, -1)
    np.take(frames.reshape(-1, frames.shape[-1]), chosen, axis=0, out=out, mode="clip")  # mode "raise" would copy once more
    return payload


def unpack_stack(payload: Frame, dtype: np.dtype[Any], shape: Sequence[int]) -> Array:
    """Unpack a payload into a read-only frame stack. Raises `BadMessage` if the payload isn't one for this shape."""
    if not _may_be_stack(dtype, shape):
        expected = f"uint8 [T+1, N, 2 to {MAX_STACK}, H, W, …] with frames of {MIN_FRAME_BYTES} bytes or more"
        raise BadMessage(f"stack: expected {expected}, got {dtype.str}{list(shape)}")
    steps, copies, k = shape[:3]
    frame_bytes = math.prod(shape[3:])
    bit_count = copies * (steps - 1)
    bit_bytes = (bit_count + 7) // 8
    fewest = bit_bytes + copies * (steps - 1 + k) * frame_bytes
    if len(payload) < fewest:
        raise BadMessage(f"stack {list(shape)}: expected at least {fewest} bytes, got {len(payload)}")
    received = np.frombuffer(payload, np.uint8)
    bits = np.unpackbits(received[:bit_bytes], bitorder="little")
    if bits[bit_count:].any():
        raise BadMessage(f"stack {list(shape)}: expected zeros after the first {bit_count} bits, got ones")
    shifted = bits[:bit_count].reshape(copies, steps - 1).view(bool)
    frame_count = copies * steps * k - (k - 1) * int(np.count_nonzero(shifted))
    total = bit_bytes + frame_count * frame_bytes
    if len(payload) != total:
        raise BadMessage(f"stack {list(shape)}: expected {total} bytes, according to its bits, got {len(payload)}")
    sent = np.full((copies, steps), k)
    sent[:, 1:] -= (k - 1) * shifted
    last = sent.cumsum().reshape(copies, steps) - 1
    shown = last.T[:, :, None] + np.arange(1 - k, 1)  # [T+1, N, k] index of each frame in the payload
    array = received[bit_bytes:].reshape(frame_count, frame_bytes).take(shown, axis=0).reshape(shape)
    array.flags.writeable = False
    return array


def _may_be_stack(dtype: np.dtype[Any], shape: Sequence[int]) -> bool:
    if not (dtype == np.uint8 and len(shape) >= 5 and shape[0] > 1 and shape[1] > 0 and 2 <= shape[2] <= MAX_STACK):
        return False
    return math.prod(shape[3:]) >= MIN_FRAME_BYTES


def _find_shifted_steps(frames: Bytes) -> Bools | None:
    """[N, T] whether each step is the step before it shifted by one frame; None if this holds for too few steps."""
    steps, copies, k, size = frames.shape
    words = frames.view(next(f"u{width}" for width in (8, 4, 2, 1) if size % width == 0))
    fewest = MIN_STACK_SAVING * steps * k / (k - 1)  # shifted steps that each copy needs on average

    def same(before: Array, after: Array) -> Bools:
        return np.asarray((before[:, :, 1:] == after[:, :, :-1]).reshape(len(after), copies, -1).all(-1))

    probes = np.arange(0, steps - 1, -(-steps // PROBED_STEPS))
    if np.count_nonzero(same(words[probes], words[probes + 1])) < probes.size * copies * fewest / steps:
        return None
    shifted = np.empty((steps - 1, copies), bool)
    chunk = max(1, COMPARED_WORDS // words[0].size)
    for t in range(0, steps - 1, chunk):
        end = min(steps - 1, t + chunk)
        shifted[t:end] = same(words[t:end], words[t + 1 : end + 1])
    return shifted.T if np.count_nonzero(shifted) >= fewest * copies else None
