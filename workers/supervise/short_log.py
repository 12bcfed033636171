"""Keeps a worker's log short while the worker, and processes that its environment starts, append to it.

Rule: if a log grows beyond `MOST` bytes, whole lines at its beginning and its end are kept, and a line says that the text
between them was removed. This doesn't disturb programs that append, because the file stays the same one.
"""

from __future__ import annotations

import os
from pathlib import Path

MOST = 16 << 20  # bytes of a log before it is shortened
BEGINNING = 1 << 20  # bytes that are kept at the beginning
END = 4 << 20  # bytes that are kept at the end
GONE = b"[millrace: the log became too long, and the text here was removed]\n"


def keep_short(log: Path, position: int) -> int:
    """Shorten the log if it is too long. Returns the new offset of the text that was at `position`.

    Text that other processes write at the same time may be lost. Raises `OSError` if the log can't be shortened.
    """
    if log.stat().st_size <= MOST:
        return position
    file = os.open(log, os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        size = os.fstat(file).st_size
        beginning = os.pread(file, BEGINNING, 0)
        kept = beginning.rfind(b"\n") + 1 or len(beginning)
        end = os.pread(file, END, size - END)
        end = end[end.find(b"\n") + 1 :]
        os.ftruncate(file, kept)
        os.write(file, GONE + end)
    finally:
        os.close(file)
    if position <= kept:
        return position
    return kept + len(GONE) + max(0, position - (size - len(end)))
