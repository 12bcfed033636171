"""Weights that a supervisor gets once and all its workers read, in a file in memory that they inherit.

Rule: the file has a few places, which the supervisor, its only writer, fills in turn. The table at its beginning says what
each holds: which version, and of which learner, by the first of that learner's sessions. So no worker takes the weights of
another run, or of a learner that was there before, although versions begin at 0 again. An entry is cleared before its place
is filled, and written after that: a reader that finds the same entry before and after it has read the place has all of it.
Whatever a worker does not find, the learner sends to it directly.

Linux only; elsewhere every worker gets weights of its own. This file imports neither numpy nor gymnasium.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator, Sequence

from millrace.protocol.alive import SHARED_VERSIONS
from millrace.protocol.wire.wake_up import WakePipe

SUPPORTED = hasattr(os, "memfd_create") and hasattr(os, "pipe2")
PLACE_BYTES = 1 << 33  # more than any message has; only what was written takes memory
FRAMES = 4  # of a message, at most
ENTRY = struct.Struct("<7Q")  # first session, version, number of frames, their lengths
SESSIONS = 1 << 24  # a learner has fewer; it draws the first of 2**48


def is_of_learner(session: int, first_session: int) -> bool:  # rule SHARED_OF_LEARNER
    """Whether this session is of the learner whose first session this is."""
    return 0 <= session - first_session < SESSIONS


class SharedWeights:
    """The supervisor's side."""

    def __init__(self) -> None:
        self._fd = os.memfd_create("millrace-weights", os.MFD_CLOEXEC)
        self._pipes: dict[str, WakePipe] = {}
        self._next = 0  # place to fill

    def descriptors(self, worker: str) -> tuple[int, int]:
        """What the worker of this name inherits: the file, and the end of a pipe which says that weights have come."""
        if worker not in self._pipes:
            self._pipes[worker] = WakePipe()
        return self._fd, self._pipes[worker].read_fd

    def write(self, first_session: int, version: int, frames: Sequence[bytes | memoryview]) -> None:
        """Share this message. Raises `OSError` without memory, and `struct.error` for what is no message of weights."""
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
    """A worker's side."""

    def __init__(self, fd: int, wake_fd: int) -> None:
        self._fd = fd
        self._wake = WakePipe(read_fd=wake_fd)
        self.wake_fd = wake_fd
        """can be read when weights have come"""

    def find(self, session: int, versions: Collection[int]) -> Iterator[list[bytes]]:
        """The messages with these versions, of the learner that has this session: those that are there."""
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
        return list(ENTRY.iter_unpack(os.pread(self._fd, size, 0).ljust(size, b"\0")))  # nothing is written yet


def _begin(place: int) -> int:
    return (place + 1) * PLACE_BYTES
