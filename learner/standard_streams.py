"""Standard output and error of a program: failed writes never end it.

Rule: a program opens what was closed at its start (`prepare_streams`), before it opens any file: otherwise a file would get
    number 1 or 2, and the output of libraries would go into it. Then `never_fails` replaces a stream. Output that a full
    disk, a closed pipe or a closed terminal refuses is dropped, and counted; a character that the encoding lacks is escaped.
    Each write is attempted, so a disk that has space again gets the next line.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, TextIO


def prepare_streams() -> None:
    """Open closed ones of standard input, output and error on a device that accepts everything and returns nothing.

    From now on characters that the encoding of output or error lacks are escaped.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number: this one
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, _writer(number, "utf-8"))
        elif isinstance(stream, io.TextIOWrapper):  # not a stream of a notebook
            stream.reconfigure(errors="backslashreplace")


@contextmanager
def unfailing(name: Literal["stdout", "stderr"]) -> Iterator[None]:
    """Until it ends, `sys.stdout` or `sys.stderr` never fails."""
    before: TextIO = getattr(sys, name)
    stream = never_fails(before)
    setattr(sys, name, stream)
    try:
        yield
    finally:
        stream.flush()
        setattr(sys, name, before)


def never_fails(stream: TextIO) -> TextIO:
    """A stream that writes where `stream` writes and never raises. One without a file descriptor is returned as it is."""
    try:
        number = stream.fileno()
        stream.flush()
    except (OSError, ValueError):  # a stream of a test or a notebook
        return stream
    return _writer(number, getattr(stream, "encoding", None) or "utf-8")


def _writer(number: int, encoding: str) -> TextIO:
    binary = io.BufferedWriter(DroppingFile(number))  # type: ignore[type-var]  # the type wants what no writer calls
    return io.TextIOWrapper(binary, encoding, "backslashreplace", line_buffering=True)


class DroppingFile(io.RawIOBase):
    """Writes to a file descriptor, which it does not close. Drops output that the descriptor refuses."""

    def __init__(self, number: int) -> None:
        self.dropped_bytes = 0
        self._number = number

    def writable(self) -> bool:
        """True."""
        return True

    def fileno(self) -> int:
        """The file descriptor."""
        return self._number

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return os.isatty(self._number)

    def write(self, content: bytes) -> int:  # type: ignore[override]  # a buffer, as io.BufferedWriter passes it
        """Write all of it, or drop the rest."""
        done = 0
        try:
            while done < len(content):
                done += os.write(self._number, content[done:])
        except OSError:
            self.dropped_bytes += len(content) - done
        return len(content)
