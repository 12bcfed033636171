"""Appends episodes to the HDF5 file of a Minari dataset, in Minari's layout.

Rule: HDF5 never sees that a write failed. If it saw a failure, for example because the disk is full, it couldn't close the
    file, and the process would end with a segmentation fault. Therefore, HDF5 writes through a file object that stores the
    first error, and keeps unwritten data in memory until HDF5 has closed the file. Only then is the error raised.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from millrace.learner.run_folder.regular_files import open_regular
from millrace.protocol.arrays import Array


def append_episodes(path: Path, first: int, episodes: Sequence[Any]) -> None:
    """Append episodes (Minari's `EpisodeBuffer`). `first`: the number of the first one; 0 makes a new file.

    Raises `OSError` if the file can't be written; the file is then unusable.
    """
    # Write in another thread, because Ctrl-C raises in the main thread, and HDF5 must not see that error either.
    with ThreadPoolExecutor(1, "recording") as writer:
        writer.submit(_append, path, first, episodes).result()


def _append(path: Path, first: int, episodes: Sequence[Any]) -> None:
    import h5py

    written = _RememberingFile(open_regular(path, os.O_RDWR | os.O_CREAT))
    try:
        with h5py.File(written, "r+" if first else "w", track_order=not first or None) as file:
            for number, episode in enumerate(episodes, first):
                group = file.create_group(f"episode_{number}")
                group.attrs["id"] = number
                group.attrs["total_steps"] = len(episode.rewards)
                if episode.seed is not None:
                    group.attrs["seed"] = episode.seed
                _add(group, "observations", episode.observations)
                _add(group, "actions", episode.actions)
                _add(group, "rewards", episode.rewards)
                _add(group, "terminations", episode.terminations)
                _add(group, "truncations", episode.truncations)
                _add(group, "infos", {})
                if written.error is not None:
                    break
    finally:
        written.close()
    if written.error is not None:
        raise written.error


def _add(group: Any, name: str, data: Any) -> None:
    """Add an array, or a group with the arrays of a Dict or Tuple. Entries of a Tuple are called `_index_0` and so on."""
    match data:
        case Mapping():
            inside = group.create_group(name)
            for key, inner in data.items():
                _add(inside, key, inner)
        case tuple():
            _add(group, name, {f"_index_{index}": inner for index, inner in enumerate(data)})
        case _:
            array: Array = np.asarray(data)
            group.create_dataset(name, data=array, chunks=True, maxshape=(None, *array.shape[1:]))


class _RememberingFile(io.RawIOBase):
    """A file for h5py to which every write seems to succeed."""

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self.error: OSError | None = None
        """the first error, if any"""
        self._descriptor = descriptor
        self._at = 0
        self._unwritten: list[tuple[int, bytes]] = []  # pairs of offset and data, in the order of writing

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to an offset from the beginning, the current position, or the end."""
        match whence:
            case os.SEEK_CUR:
                offset += self._at
            case os.SEEK_END:
                ends = (at + len(data) for at, data in self._unwritten)
                offset += max(os.fstat(self._descriptor).st_size, *ends, 0)
        self._at = offset
        return offset

    def readinto(self, buffer: Any) -> int:
        """Read the file's content, including data that couldn't be written; beyond the end, read zeros."""
        wanted = memoryview(buffer).cast("B")
        found = os.pread(self._descriptor, len(wanted), self._at)
        wanted[:] = found.ljust(len(wanted), b"\0")
        for at, data in self._unwritten:
            begin = max(at, self._at)
            end = min(at + len(data), self._at + len(wanted))
            if begin < end:
                wanted[begin - self._at : end - self._at] = data[begin - at : end - at]
        return len(wanted)

    def write(self, data: Any) -> int:
        """Write all data, or keep the data and the error in memory."""
        view = memoryview(data).cast("B")
        if not self._tried(lambda: self._write(view)):
            self._unwritten.append((self._at, bytes(view)))
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Cut or extend the file to `size`, by default to the current position."""
        length = self._at if size is None else size
        self._tried(lambda: os.ftruncate(self._descriptor, length))
        return length

    def flush(self) -> None:
        """Do nothing: no write is buffered."""

    def close(self) -> None:
        """Close the file. Some file systems report only now that there is no space."""
        if not self.closed:
            super().close()
            try:
                os.close(self._descriptor)
            except OSError as error:
                self.error = self.error or error

    def _write(self, view: memoryview) -> None:
        done = 0
        while done < len(view):
            done += os.pwrite(self._descriptor, view[done:], self._at + done)

    def _tried(self, write: Callable[[], object]) -> bool:
        """Write, unless an earlier write failed. Returns whether the write succeeded."""
        if self.error is None:
            try:
                write()
            except OSError as error:
                self.error = error
        return self.error is None
