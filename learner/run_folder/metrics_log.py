"""The metrics of a run on disk: metrics.jsonl and TensorBoard.

Rule: a file ends with a whole row, and there is one row for each update. Rows that the disk refuses are written later. A
resumed run first removes the rows that its checkpoint knows nothing of. If it makes the evaluation before which it was
interrupted, that update's row gets its metrics.
"""

from __future__ import annotations

import io
import logging
import math
import os
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from millrace.learner.run_folder.atomic_write import write_atomically
from millrace.learner.run_folder.progress import ENV_STEPS_KEY, UPDATES_KEY, Progress, Row, named
from millrace.learner.run_folder.regular_files import MOST_BYTES, open_regular, read, subfolder
from millrace.protocol.bounds import INVALID, Natural
from millrace.protocol.errors import RunError

log = logging.getLogger("millrace.learner")

METRICS_FILE = "metrics.jsonl"
MOST_LINE_BYTES = 1 << 16  # of a row that is read without the rest of the file
MOST_WAITING = 100_000  # rows that the disk refused: 100 MB of memory
EVENTS_EVERY_S = 0.2  # a fast run makes a hundred updates in that time, and an event takes as long as a small minibatch


class MetricsLog:
    """Writes metrics.jsonl and a TensorBoard events file.

    Every row goes to metrics.jsonl. TensorBoard gets a row per `EVENTS_EVERY_S`, every row with an evaluation, and the last.
    """

    def __init__(
        self,
        folder: Path,
        from_env_steps: int = 0,
        from_update: float = math.inf,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`from_env_steps`, `from_update`: of the checkpoint that the run goes on from; later rows are removed.

        An update whose rows only reset env copies adds no env step, so both are needed.
        Raises `RunError`, with a one-line message, if the files cannot be written.
        """
        table = folder / METRICS_FILE
        events = f"tensorboard/events.out.tfevents.{time.time_ns()}.{socket.gethostname()}.{os.getpid()}"
        kept: list[dict[str, Any]] = []
        self.removed = 0
        """The number of rows that were removed."""
        try:
            if table.exists():
                rows = read_rows(table)
                kept = [
                    row
                    for row in rows
                    if row[ENV_STEPS_KEY] <= from_env_steps and (row.get(UPDATES_KEY) or 0) <= from_update
                ]
                self.removed = len(rows) - len(kept)
                write_atomically(table, lambda file: file.writelines(_json_line(row) for row in kept))
            self._table = _RecordFile(folder, METRICS_FILE)
            try:
                self._events = _RecordFile(folder, events)
            except OSError:
                self._table.close()
                raise
        except OSError as error:
            raise RunError(f"{error.filename or table} cannot be written: {error.strerror}") from error
        self._events.append(_first_event(from_env_steps))
        self._events.flush()
        self._clock, self._last_event_s = clock, -math.inf
        self._newest: Row = kept[-1] if kept else {}
        self._unwritten: tuple[Row, int] | None = None  # the newest row and its env steps, if TensorBoard has not got it

    @property
    def gone(self) -> bool:
        """Whether metrics.jsonl was deleted, or its folder renamed, since its last row. `flush` makes it again."""
        return self._table.gone

    def write(self, progress: Progress, train: Row) -> None:
        """Add a row, which `flush` writes. `train`: the metrics of the algorithm, of an evaluation if any, and of callbacks.

        If the newest row is of the same update, these metrics are added to it.
        """
        event: Row = progress.row(train)
        if all(self._newest.get(key) == event[key] for key in (UPDATES_KEY, ENV_STEPS_KEY)):
            row = {**self._newest, **named(train)}
            self._table.replace(_json_line(self._newest), _json_line(row))
            event = row if self._unwritten is not None else named(train)  # TensorBoard would show a number twice
        else:
            row = dict(event)
            self._table.append(_json_line(row))
        self._newest = row
        self._unwritten = event, progress.env_steps
        if self._clock() - self._last_event_s >= EVENTS_EVERY_S or any(name.startswith("eval/") for name in row):
            self._add_event()

    def flush(self) -> None:
        """Write the rows that are not written yet. Raises `RunError`, with a one-line message, if the disk refuses them.

        The rows before them stay readable, and the next call tries again.
        """
        self._table.flush()
        self._events.flush()

    def close(self) -> None:
        """Close both files."""
        self._add_event()
        with suppress(RunError):
            self.flush()
        self._table.close()
        self._events.close()

    def _add_event(self) -> None:
        if self._unwritten is not None:
            self._events.append(_event(*self._unwritten))
            self._unwritten = None
            self._last_event_s = self._clock()


class _RecordFile:
    """A file to which whole records are appended. What the disk refuses waits, and a record that it cut off is removed.

    If the file is no longer at its path, it is made again there, with its folder.
    """

    def __init__(self, run: Path, name: str) -> None:
        """Raises OSError."""
        self._run, self._path = run, run / name
        self._waiting: deque[bytes] = deque(maxlen=MOST_WAITING)
        self._bytes = 0
        self._cut = 0  # bytes at the end of the file that the first record that waits replaces
        self._open()

    @property
    def gone(self) -> bool:
        """Whether its path names another file now, or none."""
        try:
            return not os.path.samestat(os.stat(self._path), os.fstat(self._number))
        except OSError:
            return True

    def append(self, record: bytes) -> None:
        """Add a record. It waits for `flush`."""
        self._waiting.append(record)

    def replace(self, newest: bytes, record: bytes) -> None:
        """Add a record in place of the newest one."""
        if self._waiting:
            self._waiting.pop()
        else:
            self._cut = len(newest)
        self._waiting.append(record)

    def flush(self) -> None:
        """Write the records that wait. Raises `RunError`."""
        try:
            if self.gone:
                gone = self._file
                self._open()
                gone.close()
            if self._cut:
                self._file.truncate(self._bytes - self._cut)
                self._bytes, self._cut = self._bytes - self._cut, 0
            while self._waiting:
                rest = self._waiting[0]
                while rest:  # a disk that takes a part says why with the next
                    rest = rest[self._file.write(rest) :]
                self._bytes += len(self._waiting.popleft())
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(self._bytes)
            raise RunError(f"{self._path}: rows are not written yet: {error.strerror}") from error

    def close(self) -> None:
        self._file.close()

    def _open(self) -> None:
        if self._path.parent == self._run:
            self._run.mkdir(parents=True, exist_ok=True)
        else:
            subfolder(self._run, self._path.parent.name)
        self._file = os.fdopen(open_regular(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "ab", buffering=0)
        self._number = self._file.fileno()
        self._bytes, self._cut = self._path.stat().st_size, 0


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a metrics.jsonl, each with its env steps. A last line that was cut off is ignored.

    Other rows that cannot be read are left out, and the log says how many. Raises OSError.
    """
    rows, unreadable = read_and_count_rows(path)
    if unreadable:
        log.warning("%s: %d of %d rows cannot be read; they are left out", path, unreadable, len(rows) + unreadable)
    return rows


def read_and_count_rows(path: Path) -> tuple[list[dict[str, Any]], int]:
    """The rows that can be read, and the number of others. A last line that was cut off does not count. Raises OSError."""
    *lines, _ = read(path, MOST_BYTES).split(b"\n")
    rows = [row for line in lines if (row := decoded_row(line)) is not None]
    return rows, len(lines) - len(rows)


def newest_row(run: Path) -> dict[str, Any]:
    """The last whole row of a metrics.jsonl; empty if there is none. Reads its end only. Raises OSError."""
    with os.fdopen(open_regular(run / METRICS_FILE), "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - MOST_LINE_BYTES))
        lines = file.read(MOST_LINE_BYTES).split(b"\n")[:-1]
    return next((row for line in reversed(lines) if (row := decoded_row(line)) is not None), {})


_DECODER = msgspec.json.Decoder(dict[str, int | float | None])


def decoded_row(line: bytes) -> dict[str, Any] | None:
    """A row: finite numbers, or null, by name; None if it cannot be read."""
    try:
        row = _DECODER.decode(line)
        msgspec.convert(row[ENV_STEPS_KEY], Natural)
        if not all(number is None or math.isfinite(number) for number in row.values()):
            return None
    except (*INVALID, KeyError, OverflowError):
        return None
    return row


def _json_line(row: Row) -> bytes:
    return msgspec.json.encode(row) + b"\n"


def _event(row: Row, env_steps: int) -> bytes:
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.proto.summary_pb2 import Summary

    values = [Summary.Value(tag=name, simple_value=number) for name, number in row.items() if number is not None]
    return _framed(Event(wall_time=time.time(), step=env_steps, summary=Summary(value=values)))


def _first_event(env_steps: int) -> bytes:
    """The beginning of an events file. In a resumed run it tells TensorBoard to forget what it read beyond these steps."""
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog

    version = _framed(Event(wall_time=time.time(), file_version="brain.Event:2"))
    if not env_steps:
        return version
    start = SessionLog(status=SessionLog.START)
    return version + _framed(Event(wall_time=time.time(), step=env_steps + 1, session_log=start))


def _framed(event: Any) -> bytes:
    """An event as TensorBoard frames it: length, checksum of the length, event, checksum of the event.

    TensorBoard's own writer would start a thread.
    """
    from tensorboard.summary.writer.record_writer import RecordWriter

    framed = io.BytesIO()
    RecordWriter(framed).write(event.SerializeToString())
    return framed.getvalue()
