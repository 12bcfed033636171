"""Images whose distinct channels are stored once each, because successive frame stacks contain the same frames.

Law: reading returns exactly the bytes that were written. A replay buffer uses `SharedChannels` like an array of images:
`images[slots]` copies, and `images[slots] = values` overwrites. A channel is kept as long as a slot refers to it. Channels
are identified by their digests, so a channel is shared wherever it occurs, in any slot and at any position in the stack.
"""

from __future__ import annotations

from hashlib import blake2b

import numpy as np

from millrace.protocol.arrays import Bytes, Ints
from millrace.protocol.specs import Leaf

DIGEST_BYTES = 16
CHUNK_BYTES = 1 << 24
"""Memory is allocated in chunks of about this size, so nothing is copied when the number of channels grows."""
NONE = -1
WORTHWHILE = 0.5
"""The largest share of distinct channels at which sharing saves enough memory to be worth its time."""
INDEX_BYTES = 250
"""The approximate size of the Python objects in the index by digest, per channel."""
LEAST_BYTES = 1024
"""The size of the smallest channels to share. With smaller ones, the index would use much of the memory that sharing saves.
"""


class SharedChannels:
    """An array of images [size, *leaf] uint8 that stores equal channels once."""

    def __init__(self, size: int, leaf: Leaf) -> None:
        self._leaf = leaf
        height, width, channels = leaf.shape if leaf.has_channels_last else (*leaf.shape[1:], leaf.shape[0])
        self._channel_shape = height, width
        self._channel_bytes = height * width
        self._of_slot: Ints = np.full((size, channels), NONE)  # the numbers of the channels in each slot
        self._per_chunk = max(1, CHUNK_BYTES // self._channel_bytes)
        self._chunks: list[Bytes] = []  # [channels per chunk, bytes per channel] each
        self._number: dict[bytes, int] = {}  # the number of a channel, by its digest
        self._digest: list[bytes] = []  # the digest of a channel, by its number
        self._uses: list[int] = []  # number of places in slots that refer to a channel, by its number
        self._free: list[int] = []

    @property
    def nbytes(self) -> int:
        """Memory of the channels, their numbers and the index by digest, in bytes. The index size is an estimate."""
        return self._of_slot.nbytes + sum(chunk.nbytes for chunk in self._chunks) + INDEX_BYTES * len(self._number)

    @staticmethod
    def worthwhile(leaf: Leaf, images: Bytes) -> bool:
        """Whether these images [K, *leaf] share so many channels that storing each channel once saves memory."""
        channels = _by_channel(leaf, images)
        if channels.shape[1] < LEAST_BYTES:
            return False
        distinct = {_digest(channel) for channel in channels}
        return len(distinct) <= WORTHWHILE * len(channels)

    def __getitem__(self, slots: Ints) -> Bytes:
        """Copies of the images [K, *leaf] in these slots. A slot that was never written holds zeros."""
        numbers = self._of_slot[slots]
        found = np.zeros((numbers.size, self._channel_bytes), np.uint8)
        for place, number in enumerate(numbers.ravel().tolist()):
            if number != NONE:
                found[place] = self._chunks[number // self._per_chunk][number % self._per_chunk]
        images = found.reshape(*numbers.shape, *self._channel_shape)
        return np.ascontiguousarray(np.moveaxis(images, -3, -1)) if self._leaf.has_channels_last else images

    def __setitem__(self, slots: Ints, images: Bytes) -> None:
        """Put images [K, *leaf] into these slots, which must all be different."""
        before = self._of_slot[slots].ravel().tolist()
        numbers = [self._stored(channel) for channel in _by_channel(self._leaf, images)]
        self._of_slot[slots] = np.reshape(numbers, (len(slots), -1))
        for number in before:  # last, so that a channel that stays isn't released and stored again
            if number != NONE:
                self._release(number)

    def _stored(self, channel: Bytes) -> int:
        """Store a channel [bytes per channel] unless it is known, count one more use, and return its number."""
        digest = _digest(channel)
        known = self._number.get(digest)
        if known is not None:
            self._uses[known] += 1
            return known
        if not self._free:
            self._add_chunk()
        number = self._free.pop()
        self._chunks[number // self._per_chunk][number % self._per_chunk] = channel
        self._number[digest] = number
        self._digest[number] = digest
        self._uses[number] = 1
        return number

    def _add_chunk(self) -> None:
        first = len(self._chunks) * self._per_chunk
        self._chunks.append(np.zeros((self._per_chunk, self._channel_bytes), np.uint8))
        end = first + self._per_chunk
        self._uses[first:] = [0] * self._per_chunk
        self._digest[first:] = [b""] * self._per_chunk
        self._free += range(end - 1, first - 1, -1)  # done last: if an exception prevents this, the chunk stays unused

    def _release(self, number: int) -> None:
        self._uses[number] -= 1
        if not self._uses[number]:
            del self._number[self._digest[number]]
            self._free.append(number)

    # ---------------------------------------------------------------- saving

    def saved(self, used: int) -> tuple[Bytes, Ints]:
        """The distinct channels [M, H, W] of the first `used` slots, and the indices [used, C] of each slot's channels.

        Channels are in order of first occurrence, so the result depends only on the images, and equal buffers give equal
        saved states.
        """
        numbers = self._of_slot[:used]
        distinct, first, place = np.unique(numbers, return_index=True, return_inverse=True)
        order = np.argsort(first)
        channels = np.empty((len(distinct), *self._channel_shape), np.uint8)
        for at, number in enumerate(distinct[order].tolist()):
            channels[at].flat = self._chunks[number // self._per_chunk][number % self._per_chunk]
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        return channels, rank[place].reshape(numbers.shape)

    def load(self, channels: Bytes, numbers: Ints) -> None:
        """Restore the result of `saved`. Call this before anything is written to the array."""
        for at, of_slot in enumerate(numbers):
            images = channels[of_slot]
            self[np.array([at])] = np.moveaxis(images, 0, -1)[None] if self._leaf.has_channels_last else images[None]


def _by_channel(leaf: Leaf, images: Bytes) -> Bytes:
    """The channels of images [K, *leaf], as a contiguous array [K · C, H · W]."""
    first = np.moveaxis(images, -1, 1) if leaf.has_channels_last else images
    return np.ascontiguousarray(first).reshape(first.shape[0] * first.shape[1], -1)


def _digest(channel: Bytes) -> bytes:
    return blake2b(channel.tobytes(), digest_size=DIGEST_BYTES).digest()
