"""The log as JSON, one event per line: all of it on stderr (`--log-json`), and its warnings and notices in a file.

The file is log.jsonl in the run folder. Every line has `time` (UTC, ISO 8601), `level`, `event` and `message` (the text that
people read). `event` is "joined", "left", "refused", "environment_raised", "policy_raised", "process_failed" or
"asked_to_rejoin" (`millrace.learner.members.events`, with the fields of the event), "progress", or "said" for any other line
of the log.

Rule: the size of log.jsonl is bounded, and nothing depends on the file. If it grows too long, only the newer half is kept.
Lines that can't be written are dropped. The file is opened for each line, because somebody may delete it, or its folder, in
between.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from millrace.learner.run_folder.atomic_write import write_atomically
from millrace.learner.run_folder.progress import NOT_SHOWN, Progress
from millrace.learner.run_folder.regular_files import open_regular
from millrace.learner.run_folder.sentences import steps_in_words
from millrace.protocol.bounds import INVALID, escaped_json
from millrace.protocol.logs.notices import is_notice

RUN_LOG_FILE = "log.jsonl"
MOST_BYTES_OF_LOG = 1 << 20
READ_BYTES = 1 << 16


class JsonLines(logging.Formatter):
    """Formats a log record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line break."""
        level = "info" if is_notice(record) else record.levelname.lower()
        kind = getattr(record, "event", "said")
        return _line(record.created, level, kind, record.getMessage(), getattr(record, "event_fields", {}))


def progress_line(progress: Progress, now: float) -> str:
    """The progress of the run as one line of JSON. `now` is wall-clock time."""
    message = f"{steps_in_words(progress)} env steps"
    shown = (name for name in progress.__struct_fields__ if name not in NOT_SHOWN)
    fields = {name: msgspec.to_builtins(getattr(progress, name)) for name in shown}
    return _line(now, "info", "progress", message, fields)


def _line(time: float, level: str, event: str, message: str, fields: dict[str, Any]) -> str:
    stamp = datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds")
    line = {"time": stamp, "level": level, "event": event, "message": message, **fields}
    return escaped_json(msgspec.json.encode(line).decode())


class LoggedLine(msgspec.Struct, frozen=True):
    """A line of the log, with its time in the local time zone."""

    time: Annotated[datetime, Meta(tz=True)]
    level: str
    message: str
    """The text that people read. If it has several lines, those after the first are a traceback."""


@contextmanager
def kept_log(folder: Path) -> Iterator[None]:
    """Inside this context, also write millrace's warnings and notices to the log in this run folder."""
    handler = _RunLog(folder / RUN_LOG_FILE)
    logger = logging.getLogger("millrace")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def newest_lines(folder: Path) -> list[LoggedLine]:
    """The last lines of a run folder's log, the oldest first. Empty if none can be read."""
    try:
        with os.fdopen(open_regular(folder / RUN_LOG_FILE), "rb") as file:
            lines = _end(file.fileno(), READ_BYTES).splitlines()
    except OSError:
        return []
    found = []
    for line in lines:
        with suppress(*INVALID, OverflowError):
            logged = msgspec.json.decode(line, type=LoggedLine)
            found.append(replace(logged, time=logged.time.astimezone()))
    return found


class _RunLog(logging.Handler):
    def __init__(self, path: Path) -> None:
        super().__init__(logging.WARNING)
        self._path = path
        self.setFormatter(JsonLines())

    def emit(self, record: logging.LogRecord) -> None:
        """Append one line, unless the record is a notice that log.jsonl leaves out."""
        if not getattr(record, "kept", True):
            return
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
    """The last whole lines of a file, at most this many bytes. Raises OSError."""
    begin = max(0, os.fstat(file).st_size - most)
    end = os.pread(file, most, begin)
    return end.partition(b"\n")[2] if begin else end
