"""Writes a run's metrics as TensorBoard events, into the subfolder tensorboard of the run folder.

Rule: events that can't be written, for example because the disk is full, are written later, like all files of a run. A
resumed run writes a file of its own, which tells TensorBoard to discard the events after the checkpoint.
"""

from __future__ import annotations

import io
import os
import socket
import time

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from millrace import Progress
from millrace.extras.monitoring.run_rows import RowCallback
from millrace.learner.run_folder.record_file import RecordFile
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.errors import RunError

EVERY_S = 0.2  # a fast run has a hundred updates in this time, and writing an event takes as long as a small minibatch


class TensorBoardCallback(RowCallback):
    """Writes one row every `EVERY_S` seconds, and in addition every row with an evaluation and the last row."""

    def __init__(self, folder: RunFolder, every_s: float = EVERY_S) -> None:
        """`every_s`: minimum number of seconds between two rows."""
        super().__init__("tensorboard", every_s)
        self._folder = folder
        self._file: RecordFile | None = None

    def _begin(self, progress: Progress) -> None:
        name = f"tensorboard/events.out.tfevents.{time.time_ns()}.{socket.gethostname()}.{os.getpid()}"
        try:
            self._file = RecordFile(self._folder.path, name)
        except OSError as error:
            raise RunError(f"{error.filename or self._folder.path / name} cannot be written: {error.strerror}") from error
        self._write(Event(wall_time=time.time(), file_version="brain.Event:2"))
        if progress.env_steps:
            start = SessionLog(status=SessionLog.START)
            self._write(Event(wall_time=time.time(), step=progress.env_steps + 1, session_log=start))

    def _send(self, row: dict[str, float], progress: Progress) -> None:
        values = [Summary.Value(tag=name, simple_value=number) for name, number in row.items()]
        self._write(Event(wall_time=time.time(), step=progress.env_steps, summary=Summary(value=values)))

    def _end(self, progress: Progress) -> None:
        if self._file is None:
            return
        self._log(self._rows.last(progress), progress)
        self._file.close()

    def _write(self, event: Event) -> None:
        assert self._file is not None
        self._file.append(_framed(event))
        self._folder.writes.write("events", self._file.flush)


def _framed(event: Event) -> bytes:
    """An event in TensorBoard's framing: length, checksum of the length, event, checksum of the event.

    TensorBoard's own event writer isn't used, because it would start a thread.
    """
    framed = io.BytesIO()
    RecordWriter(framed).write(event.SerializeToString())
    return framed.getvalue()
