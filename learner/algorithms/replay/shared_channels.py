"""Images whose channels are stored once each, because those of a frame stack are the same frames over and over.

Law: what is read is what was written, to the byte. It is an array of images in all that a replay buffer asks of one:
`images[slots]` copies, `images[slots] = values` overwrites. A channel is kept as long as a slot refers to it, and is known
by its digest, so it doesn't matter in which slot, in which place or how often it stands.
"""

from __future__ import annotations

from hashlib import blake2b

import numpy as np

from millrace.protocol.arrays import Bytes, Ints
from millrace.protocol.specs import Leaf

DIGEST_BYTES = 16
CHUNK_BYTES = 1 << 24
"""Memory is taken in pieces of about this size, so that none is copied when there are more channels"""
NONE = -1
WORTHWHILE = 0.5
"""Share of the channels of some images that may differ, at most, for storing them once to be worth its time"""
INDEX_BYTES = 250
"""of the index by digest, for each channel: about what Python's objects take"""
LEAST_BYTES = 1024
"""of a channel: the index of smaller ones would take a large part of what sharing saves"""


class SharedChannels:
    """[size, *leaf] uint8 images."""

    def __init__(self, size: int, leaf: Leaf) -> None:
        self._leaf = leaf
        height, width, channels = leaf.shape if leaf.has_channels_last else (*leaf.shape[1:], leaf.shape[0])
        self._channel_shape = height, width
        self._channel_bytes = height * width
        self._of_slot: Ints = np.full((size, channels), NONE)  # numbers of its channels
        self._per_chunk = max(1, CHUNK_BYTES // self._channel_bytes)
        self._chunks: list[Bytes] = []  # [channels of a chunk, bytes of a channel] each
        self._number: dict[bytes, int] = {}  # of a digest
        self._digest: list[bytes] = []  # of each number
        self._uses: list[int] = []  # how many places of slots refer to each number
        self._free: list[int] = []

    @property
    def nbytes(self) -> int:
        """Memory of the channels, their numbers and the index by digest, in bytes; that of the index is an estimate."""
        return self._of_slot.nbytes + sum(chunk.nbytes for chunk in self._chunks) + INDEX_BYTES * len(self._number)

    @staticmethod
    def worthwhile(leaf: Leaf, images: Bytes) -> bool:
        """Whether these images [K, *leaf] share so many channels that storing each once saves memory."""
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
        """Put images [K, *leaf] into these slots, which must differ."""
        before = self._of_slot[slots].ravel().tolist()
        numbers = [self._stored(channel) for channel in _by_channel(self._leaf, images)]
        self._of_slot[slots] = np.reshape(numbers, (len(slots), -1))
        for number in before:  # last, so that a channel that stays isn't stored again
            if number != NONE:
                self._release(number)

    def _stored(self, channel: Bytes) -> int:
        """The number of a channel [bytes of a channel], which has one more use now."""
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
        self._free += range(end - 1, first - 1, -1)  # last: without it, the chunk would only stay empty

    def _release(self, number: int) -> None:
        self._uses[number] -= 1
        if not self._uses[number]:
            del self._number[self._digest[number]]
            self._free.append(number)

    # ---------------------------------------------------------------- saving

    def saved(self, used: int) -> tuple[Bytes, Ints]:
        """The channels [M, H, W] of the first slots, in the order in which they stand there, and their numbers [used, C].

        They depend on nothing but the images, so equal buffers are saved alike.
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
        """Hold what was saved. Call it before anything is written."""
        for at, of_slot in enumerate(numbers):
            images = channels[of_slot]
            self[np.array([at])] = np.moveaxis(images, 0, -1)[None] if self._leaf.has_channels_last else images[None]


def _by_channel(leaf: Leaf, images: Bytes) -> Bytes:
    """Images [K, *leaf] as channels [K · C, H · W], contiguous."""
    first = np.moveaxis(images, -1, 1) if leaf.has_channels_last else images
    return np.ascontiguousarray(first).reshape(first.shape[0] * first.shape[1], -1)


def _digest(channel: Bytes) -> bytes:
    return blake2b(channel.tobytes(), digest_size=DIGEST_BYTES).digest()
