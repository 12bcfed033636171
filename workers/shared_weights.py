"""Weights that a supervisor receives once for all its workers, in an in-memory file that they inherit.

Rule: the file has a few places, which the supervisor, its only writer, fills in turn. A table at the beginning of the file
says which version each place contains, and from which learner (identified by the learner's first session). Thus, no worker
uses weights from another run or an earlier learner, although each learner counts versions from 0. An entry of the table is
cleared before its place is filled, and written afterwards, so a reader that finds the same entry before and after reading
the place has read consistent weights. If a worker doesn't find weights that it needs, the learner sends them to it directly.

This works only on Linux; elsewhere, the learner sends the weights to every worker. This file imports neither numpy nor
gymnasium.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator, Sequence

from millrace.protocol.alive import SHARED_VERSIONS
from millrace.protocol.wire.wake_up import WakePipe

SUPPORTED = hasattr(os, "memfd_create") and hasattr(os, "pipe2")
PLACE_BYTES = 1 << 33  # more than the largest message; only pages that were written use memory
FRAMES = 4  # largest number of frames in a message
ENTRY = struct.Struct("<7Q")  # first session, version, number of frames, lengths of the frames
SESSIONS = 1 << 24  # a learner has fewer sessions than this; the number of its first one is random, below 2**48


def is_of_learner(session: int, first_session: int) -> bool:  # rule SHARED_OF_LEARNER
    """Whether this session belongs to the learner whose first session was `first_session`."""
    return 0 <= session - first_session < SESSIONS


class SharedWeights:
    """The supervisor's side of the file: it writes weights."""

    def __init__(self) -> None:
        self._fd = os.memfd_create("millrace-weights", os.MFD_CLOEXEC)
        self._pipes: dict[str, WakePipe] = {}
        self._next = 0  # the place to fill next

    def descriptors(self, worker: str) -> tuple[int, int]:
        """The descriptors that this worker inherits: the file, and the read end of a pipe that announces new weights."""
        if worker not in self._pipes:
            self._pipes[worker] = WakePipe()
        return self._fd, self._pipes[worker].read_fd

    def write(self, first_session: int, version: int, frames: Sequence[bytes | memoryview]) -> None:
        """Share the frames of a `Weights` message with all workers.

        Raises `OSError` if there is no memory, and `struct.error` if this isn't such a message.
        """
        lengths = [*map(len, frames), *[0] * (FRAMES - len(frames))]
        entry = ENTRY.pack(first_session, version, len(frames), *lengths)
        place = self._next
        at = _begin(place)
        self._next = (place + 1) % SHARED_VERSIONS
        os.pwrite(self._fd, bytes(ENTRY.size), place * ENTRY.size)
        for frame in frames:
            if os.pwrite(self._fd, frame, at) < len(frame):
                raise OSError("no memory for weights")
            at += len(frame)
        os.pwrite(self._fd, entry, place * ENTRY.size)
        for pipe in self._pipes.values():
            pipe.wake()

    def close(self) -> None:
        """Close the descriptors."""
        os.close(self._fd)
        for pipe in self._pipes.values():
            pipe.close()


class SharedWeightsReader:
    """A worker's side of the file: it reads weights."""

    def __init__(self, fd: int, wake_fd: int) -> None:
        self._fd = fd
        self._wake = WakePipe(read_fd=wake_fd)
        self.wake_fd = wake_fd
        """descriptor that can be read when weights have arrived"""

    def find(self, session: int, versions: Collection[int]) -> Iterator[list[bytes]]:
        """The frames of the available `Weights` messages with these versions, from the learner of this session."""
        self._wake.wait(0.0)
        if not versions:
            return
        for place, entry in enumerate(self._table()):
            first_session, version, frames, *lengths = entry
            if not frames or version not in versions or not is_of_learner(session, first_session):
                continue
            found = []
            at = _begin(place)
            for length in lengths[:frames]:
                found.append(os.pread(self._fd, length, at))
                at += length
            if self._table()[place] == entry:
                yield found

    def _table(self) -> list[tuple[int, ...]]:
        size = SHARED_VERSIONS * ENTRY.size
        return list(ENTRY.iter_unpack(os.pread(self._fd, size, 0).ljust(size, b"\0")))  # zeros if nothing was written yet


def _begin(place: int) -> int:
    return (place + 1) * PLACE_BYTES
