"""The warnings and notices of a run in its folder, log.jsonl: what failed in the night, in the form of `--log-json`.

Rule: it is bounded, and nothing depends on it. Of a file that has grown too long, the newer half is kept. Lines that the
disk refuses are dropped. It is opened for each line, because somebody may delete it, or the folder, while the run trains.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

import msgspec

from learner.run_folder.atomic_write import write_atomically
from learner.run_folder.json_log import JsonLines
from learner.run_folder.regular_files import open_regular

RUN_LOG_FILE = "log.jsonl"
MOST_BYTES_OF_LOG = 1 << 20
READ_BYTES = 1 << 16


class LoggedLine(msgspec.Struct, frozen=True):
    """A line of the log."""

    time: datetime
    level: str
    message: str
    """Lines after the first are a traceback."""


@contextmanager
def kept_log(folder: Path) -> Iterator[None]:
    """What millrace warns of goes into the folder, too."""
    handler = _RunLog(folder / RUN_LOG_FILE)
    logger = logging.getLogger("millrace")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def newest_lines(folder: Path) -> list[LoggedLine]:
    """The last lines of the log of a run folder, the oldest first. Empty if it has none that can be read."""
    try:
        with os.fdopen(open_regular(folder / RUN_LOG_FILE), "rb") as file:
            lines = _end(file.fileno(), READ_BYTES).splitlines()
    except OSError:
        return []
    found = []
    for line in lines:
        with suppress(msgspec.MsgspecError, UnicodeError, RecursionError):
            found.append(msgspec.json.decode(line, type=LoggedLine))
    return found


class _RunLog(logging.Handler):
    def __init__(self, path: Path) -> None:
        super().__init__(logging.WARNING)
        self._path = path
        self.setFormatter(JsonLines())

    def emit(self, record: logging.LogRecord) -> None:
        """Append one line."""
        with suppress(OSError, UnicodeError):
            file = open_regular(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT)
            try:
                os.write(file, self.format(record).encode() + b"\n")
                if os.fstat(file).st_size > MOST_BYTES_OF_LOG:
                    newer = _end(file, MOST_BYTES_OF_LOG // 2)
                    write_atomically(self._path, lambda shorter: shorter.write(newer))
            finally:
                os.close(file)


def _end(file: int, most: int) -> bytes:
    """Whole lines from the end of a file, of so many bytes at most. Raises OSError."""
    begin = max(0, os.fstat(file).st_size - most)
    end = os.pread(file, most, begin)
    return end.partition(b"\n")[2] if begin else end
