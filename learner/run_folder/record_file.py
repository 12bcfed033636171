"""A file of a run that grows by whole records, such as metrics.jsonl.

Rule: the file ends with a whole record. Records that can't be written now wait in memory and are written later. A record
that replaces the newest one is written over it, starting at the first byte that differs. If the process is killed while it
writes, the file keeps at least the bytes that both records have in common, and no mixture of two numbers.
"""

from __future__ import annotations

import os
from collections import deque
from contextlib import suppress
from pathlib import Path

from millrace.learner.run_folder.regular_files import open_regular, subfolder
from millrace.protocol.errors import RunError

END = b"}\n"  # the end of a record that is replaced, which is a line of JSON
MOST_WAITING = 100_000  # limit on the records that wait to be written; that many rows of metrics take 100 MB of memory


class RecordFile:
    """A file to which whole records are appended. A partially written record is removed and written again.

    If the file is no longer at its path, it is recreated there, with its folder.
    """

    def __init__(self, run: Path, name: str) -> None:
        """`name` is the name of a file in this run folder or in one of its subfolders. Raises OSError."""
        self._run = run
        self._path = run / name
        self._waiting: deque[bytes] = deque(maxlen=MOST_WAITING)
        self._bytes = 0
        self._replaced = b""  # the record at the end of the file that the first waiting record replaces
        self._open()

    @property
    def gone(self) -> bool:
        """Whether the path no longer leads to this file."""
        try:
            return not os.path.samestat(os.stat(self._path), os.fstat(self._number))
        except OSError:
            return True

    def append(self, record: bytes) -> None:
        """Add a record, which waits until `flush` writes it."""
        self._waiting.append(record)

    def replace(self, newest: bytes, record: bytes) -> None:
        """Replace the newest record, whose content is `newest`, with this record."""
        if self._waiting:
            self._waiting.pop()
        else:
            self._replaced = newest
        self._waiting.append(record)

    def flush(self) -> None:
        """Write the waiting records. Raises `RunError` if that fails; the remaining records then keep waiting."""
        try:
            if self.gone:
                gone = self._file
                self._open()
                gone.close()
            if self._replaced:
                self._overwrite(self._replaced, self._waiting[0])
                self._replaced = b""
                self._waiting.popleft()
            while self._waiting:
                rest = self._waiting[0]
                while rest:  # if only a part was written, the next write raises and says why
                    rest = rest[self._file.write(rest) :]
                self._bytes += len(self._waiting.popleft())
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(self._bytes)
            raise RunError(f"{self._path}: rows are not written yet: {error.strerror}") from error

    def sync(self) -> None:
        """Write the waiting records, and wait until the file is on the disk. Raises `RunError` if that fails."""
        self.flush()
        try:
            os.fsync(self._number)
        except OSError as error:
            raise RunError(f"{self._path}: rows may not be on the disk: {error.strerror}") from error

    def close(self) -> None:
        """Close the file without writing the waiting records."""
        self._file.close()

    def _overwrite(self, old: bytes, new: bytes) -> None:
        """Write `new` over `old`, the record at the end of the file. If that fails, `old` is restored as far as possible."""
        differ = (at for at, (one, other) in enumerate(zip(old, new, strict=False)) if one != other)
        equal = next(differ, min(len(old), len(new)))
        begin = self._bytes - len(old)
        file = open_regular(self._path, os.O_WRONLY)  # Linux appends even with `pwrite` to a file opened for appending
        try:
            if equal < len(old) - len(END):  # the new record changes a number
                os.ftruncate(file, begin + equal)
            _write_at(file, new[equal:], begin + equal)
            os.ftruncate(file, begin + len(new))
            self._bytes = begin + len(new)
        except OSError:
            with suppress(OSError):
                _write_at(file, old[equal:], begin + equal)
            raise
        finally:
            os.close(file)

    def _open(self) -> None:
        if self._path.parent == self._run:
            self._run.mkdir(parents=True, exist_ok=True)
        else:
            subfolder(self._run, self._path.parent.name)
        self._file = os.fdopen(open_regular(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "ab", buffering=0)
        self._number = self._file.fileno()
        self._bytes = self._path.stat().st_size
        self._replaced = b""


def _write_at(file: int, rest: bytes, offset: int) -> None:
    while rest:  # if only a part was written, the next write raises and says why
        written = os.pwrite(file, rest, offset)
        rest = rest[written:]
        offset += written
