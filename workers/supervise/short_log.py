"""Keeps the log of a worker short while the worker, and what its environment starts, append to it.

Rule: if a log grows beyond `MOST` bytes, whole lines at its beginning and end stay, and a line says that the text between
them was removed. Programs that append don't notice: the file stays the same, and is open for appending.
"""

from __future__ import annotations

import os
from pathlib import Path

MOST = 16 << 20  # bytes
BEGINNING = 1 << 20  # bytes that stay
END = 4 << 20  # bytes that stay
GONE = b"[millrace: the log became too long, and the text here was removed]\n"


def keep_short(log: Path, position: int) -> int:
    """Shorten the log if it is too long.

    Returns the new offset of the text that was at `position`. Raises `OSError`. Text that is written meanwhile may be lost.
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
