"""Standard output and standard error whose failed writes never end the program.

Rule: before it opens any file, a program opens the standard streams that were closed at its start (`prepare_streams`).
Otherwise, a file that it opens could get number 1 or 2, and the output of libraries would go into that file. Once the
streams are open, `never_fails` can replace one. Output that cannot be written, because of a full disk, a closed pipe or a
closed terminal, is dropped and counted; a character that the encoding lacks is escaped. Every write is attempted, so when
a full disk has space again, it gets the next line.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, TextIO


def prepare_streams() -> None:
    """Open the null device in place of each standard stream (input, output or error) that is closed.

    From then on, characters that the encoding of standard output or error lacks are escaped.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, _writer(number, "utf-8"))
        elif isinstance(stream, io.TextIOWrapper):  # not so in a notebook
            stream.reconfigure(errors="backslashreplace")


@contextmanager
def unfailing(name: Literal["stdout", "stderr"]) -> Iterator[None]:
    """Inside this context, writes to `sys.stdout` or `sys.stderr` never fail."""
    before: TextIO = getattr(sys, name)
    stream = never_fails(before)
    setattr(sys, name, stream)
    try:
        yield
    finally:
        stream.flush()
        setattr(sys, name, before)


def never_fails(stream: TextIO) -> TextIO:
    """A stream that writes where `stream` does but never raises. Returns `stream` itself if it has no file descriptor."""
    try:
        number = stream.fileno()
        stream.flush()
    except (OSError, ValueError):  # the stream belongs to a test or a notebook
        return stream
    return _writer(number, getattr(stream, "encoding", None) or "utf-8")


def _writer(number: int, encoding: str) -> TextIO:
    binary = io.BufferedWriter(DroppingFile(number))  # type: ignore[type-var]  # the type requires methods that nobody calls
    return io.TextIOWrapper(binary, encoding, "backslashreplace", line_buffering=True)


class DroppingFile(io.RawIOBase):
    """Writes to a file descriptor, which it does not close. Drops output that cannot be written."""

    def __init__(self, number: int) -> None:
        self.dropped_bytes = 0
        self._number = number

    def writable(self) -> bool:
        """Always True."""
        return True

    def fileno(self) -> int:
        """The file descriptor."""
        return self._number

    def isatty(self) -> bool:
        """Whether the file is a terminal."""
        return os.isatty(self._number)

    def write(self, content: bytes) -> int:  # type: ignore[override]  # a buffer, as io.BufferedWriter passes it
        """Write as much of `content` as possible, and drop the rest. Always returns the length of `content`."""
        done = 0
        try:
            while done < len(content):
                done += os.write(self._number, content[done:])
        except OSError:
            self.dropped_bytes += len(content) - done
        return len(content)
