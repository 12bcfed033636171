"""Writes a .npy file with a row for each step: the observation and the action, flattened, as float32.

Rule: the file is complete, or doesn't exist.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np

from millrace.extras.datasets.episodes import RecordedEpisode
from millrace.learner.run_folder.atomic_write import write_atomically
from millrace.protocol.errors import RunError


class NpyRows:
    """A context manager that collects rows in a temporary file and, unless the body raises, finally writes the .npy file."""

    def __init__(self, target: Path | None) -> None:
        """`target`: the file to write. With None, nothing is written and every method does nothing."""
        self._target = target
        self._shape = (0, 0)

    def add(self, episode: RecordedEpisode) -> None:
        """Add a row for each step. The last observation gets no row, because no action followed it."""
        if self._target is None:
            return
        columns = [*(leaf[:-1] for leaf in episode.obs), *episode.action]
        rows = np.concatenate([np.reshape(column, (episode.length, -1)) for column in columns], axis=1, dtype="<f4")
        with self._as_run_error():
            self._file.write(rows.tobytes())
        self._shape = (self._shape[0] + len(rows), rows.shape[1])

    def __enter__(self) -> Self:
        if self._target is not None:
            with self._as_run_error():
                self._file = tempfile.TemporaryFile(dir=self._target.parent)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._target is not None:
            with self._as_run_error(), self._file:
                if error is None:
                    write_atomically(self._target, self._copy_to)

    def _copy_to(self, file: BinaryIO) -> None:
        self._file.seek(0)
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": self._shape})
        shutil.copyfileobj(self._file, file)

    @contextmanager
    def _as_run_error(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RunError(f"{self._target} was not written: {error.strerror}") from error
