"""Writes files that are there whole or not at all.

Rule: a file is written beside the target under a name that ends with `.tmp`, flushed to the disk, and then renamed to the
target; the folder is flushed too. If anything fails, the target stays as it was and the temporary file is removed.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

TEMPORARY = ".tmp"


def write_atomically(target: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let `write` fill the file and replace the target by it. Raises what `write` or the file system raises."""
    temporary = target.with_name(target.name + TEMPORARY)
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _flush_folder(target.parent)


def _flush_folder(folder: Path) -> None:
    """Make sure that the new name survives a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
