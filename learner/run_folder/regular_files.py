"""Opens and lists the files of a run folder.

Rule: a run folder may come from a stranger, so only regular files inside it are read and written. Links are not followed,
and a FIFO, a device or a folder in place of a file is refused with an `OSError` that says what is there. Other packages
write into a `subfolder`, which can't be a link either.
"""

from __future__ import annotations

import errno
import logging
import os
import stat
from contextlib import suppress
from pathlib import Path

from millrace.protocol.errors import first_line

MOST_TEXT_BYTES = 1 << 22  # limit on the size of a file of settings or results
MOST_BYTES = 1 << 31  # limit on the size of a file of metrics, or of a policy's arrays

log = logging.getLogger("millrace.learner")


def open_regular(path: Path, flags: int = os.O_RDONLY) -> int:
    """Open a file as `os.open` does, and return its descriptor.

    Raises `OSError` if that fails, or if it isn't a regular file.
    """
    try:
        file = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    except OSError:
        with suppress(FileNotFoundError):
            _expect(stat.S_IFREG, path.lstat().st_mode, path)
        raise
    try:
        _expect(stat.S_IFREG, os.fstat(file).st_mode, path)
    except OSError:
        os.close(file)
        raise
    return file


def read(path: Path, most_bytes: int = MOST_TEXT_BYTES) -> bytes:
    """The content of a file. Raises `OSError` if it can't be read or has more than `most_bytes`."""
    with os.fdopen(open_regular(path), "rb") as file:
        if (size := os.fstat(file.fileno()).st_size) > most_bytes:
            raise OSError(errno.EFBIG, f"expected at most {most_bytes:,} bytes, got {size:,}", str(path))
        return file.read()


def regular_files(run: Path, pattern: str) -> list[Path]:
    """The regular files of a run folder that match a pattern, such as `videos/*.mp4`, sorted by name.

    Anything else with such a name is left out, and the log says so.
    """
    folder, _, name = pattern.rpartition("/")
    if folder and not _is(stat.S_IFDIR, run / folder):
        return []
    return [path for path in sorted((run / folder).glob(name)) if _is(stat.S_IFREG, path)]


def subfolder(run: Path, name: str) -> Path:
    """Make a folder inside a run folder unless it exists, and return its path.

    Raises `OSError` if that fails, or if something else, such as a link, has this name.
    """
    folder = run / name
    folder.mkdir(parents=True, exist_ok=True)
    _expect(stat.S_IFDIR, folder.lstat().st_mode, folder)
    return folder


def reason(error: Exception) -> str:
    """Why a file cannot be read or written, in one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return first_line(error, type(error).__name__).rstrip(".")


def _expect(kind: int, mode: int, path: Path) -> None:
    """Raise `OSError` unless the file is of this kind."""
    if stat.S_IFMT(mode) != kind:
        expected, got = (KINDS.get(each, "a device") for each in (kind, stat.S_IFMT(mode)))
        raise OSError(errno.EINVAL, f"expected {expected}, got {got}", str(path))


def _is(kind: int, path: Path) -> bool:
    """Whether the file is of this kind. If it isn't, the log says what it is."""
    try:
        _expect(kind, path.lstat().st_mode, path)
    except FileNotFoundError:
        return False
    except OSError as error:
        log.warning("%s: %s; it is left out", path, reason(error))
        return False
    return True


KINDS = {
    stat.S_IFREG: "a file",
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
}
