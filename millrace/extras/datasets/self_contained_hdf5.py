"""Reads groups and arrays of an HDF5 file from an untrusted source, and never reads any other file.

Rule: no link is followed, and all data of an array must be in the file, compressed only with h5py's own filters. Memory is
therefore bounded by the file's size, because an array has at most `MOST_EXPANSION` times as many bytes.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from millrace.learner.run_folder.regular_files import open_regular

MOST_EXPANSION = 1_032  # deflate's largest compression ratio; no other supported filter has a larger one
FILTERS = {1, 2, 3, 32_000}  # deflate, shuffle, fletcher32, lzf; for any other number, HDF5 might load a plug-in


class UnfitFile(Exception):
    """The file can't be used. The message says why, in one line."""


class SelfContainedHDF5:
    """An open file. Its methods raise `UnfitFile` or, if the file is damaged, one of several h5py errors."""

    def __init__(self, file: Any, most_bytes: int) -> None:
        """`most_bytes`: the largest allowed size of an array."""
        self.root = file
        self.most_bytes = most_bytes

    @classmethod
    @contextmanager
    def open(cls, path: Path) -> Iterator[Self]:
        """Open a file for reading. Raises `OSError`, even for a link or anything else that isn't a regular file."""
        import h5py

        with os.fdopen(open_regular(path), "rb") as opened, h5py.File(opened, "r") as file:
            yield cls(file, os.fstat(opened.fileno()).st_size * MOST_EXPANSION)

    def group(self, parent: Any, name: str) -> Any:
        """The group with this name inside another group."""
        import h5py

        if not isinstance(member := self._member(parent, name), h5py.Group):
            raise UnfitFile(f"{member.name}: expected a group, got {type(member).__name__}")
        return member

    def array(self, parent: Any, name: str) -> Any:
        """The array with this name inside a group, as h5py's `Dataset`. Its data isn't read yet."""
        import h5py

        dataset = self._member(parent, name)
        if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
            raise UnfitFile(f"{dataset.name}: expected an array, got {type(dataset).__name__}")
        if dataset.is_virtual or dataset.external:
            raise UnfitFile(f"{dataset.name}: expected its data in this file, got an array that names other files")
        creation = dataset.id.get_create_plist()
        if unknown := {creation.get_filter(each)[0] for each in range(creation.get_nfilters())} - FILTERS:
            raise UnfitFile(f"{dataset.name}: expected no compression, gzip or lzf, got filter {min(unknown)}")
        elements = max(dataset.size, math.prod(dataset.chunks or ()))  # HDF5 decompresses whole chunks
        if (most := elements * dataset.dtype.itemsize) > self.most_bytes:
            raise UnfitFile(
                f"{dataset.name}: expected at most {self.most_bytes:,} bytes in a file of this size, got {most:,}"
            )
        if not _is_whole(dataset):
            raise UnfitFile(f"{dataset.name}: expected all of its data in this file, got a part of them")
        return dataset

    def _member(self, parent: Any, name: str) -> Any:
        import h5py

        where = f"{parent.name.rstrip('/')}/{name}"
        link = parent.get(name, getlink=True)
        if link is None:
            raise UnfitFile(f"expected {where}, got none")
        if "/" in name or not isinstance(link, h5py.HardLink):
            raise UnfitFile(f"{where}: expected a name in this file, got a link")
        return parent[name]


def _is_whole(array: Any) -> bool:
    """Whether the file contains all data of an array. For data that was never written, HDF5 returns a fill value."""
    if not array.chunks:
        return bool(array.id.get_storage_size() >= array.nbytes)
    sides = zip(array.shape, array.chunks, strict=True)
    return bool(array.id.get_num_chunks() >= math.prod(-(-length // chunk) for length, chunk in sides))
