"""The metrics of a run on disk: metrics.jsonl.

Rule: the file ends with a complete row, and there is one row for each update. Rows that can't be written now are written
later. The rows up to a checkpoint are flushed to the disk before the checkpoint, because a resumed run doesn't write them
again. A resumed run removes the rows after its checkpoint. If the run was interrupted before an evaluation, the resumed run
does this evaluation and adds its metrics to the row of the same update. If the run was killed while it wrote a row, the
resumed run keeps those numbers of the row that are complete.

A row has room for one evaluation. If evaluations of two policies end after the same update, the row is repeated with the
second evaluation's metrics.
"""

from __future__ import annotations

import logging
import math
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from millrace.learner.run_folder.atomic_write import write_atomically
from millrace.learner.run_folder.progress import ENV_STEPS_KEY, UPDATES_KEY, Progress, Row, named
from millrace.learner.run_folder.record_file import RecordFile
from millrace.learner.run_folder.regular_files import MOST_BYTES, open_regular, read
from millrace.learner.run_folder.results import EVALUATED_AT_KEY, EVALUATION_KEY
from millrace.protocol.bounds import INVALID, Natural
from millrace.protocol.errors import RunError

log = logging.getLogger("millrace.learner")

METRICS_FILE = "metrics.jsonl"
MOST_LINE_BYTES = 1 << 16  # size of the longest row that is read while the file grows
MOST_COMMAS = 10  # how many commas the name of the last number in a cut-off row may contain


class MetricsLog:
    """Writes metrics.jsonl."""

    def __init__(self, folder: Path, from_env_steps: int = 0, from_update: float = math.inf) -> None:
        """Removes the rows after the checkpoint that the run continues, which is at `from_env_steps` and `from_update`.

        Both numbers are needed, because an update whose rows only reset env copies adds no env step. Raises `RunError`, with
        a one-line message, if the file cannot be written.
        """
        table = folder / METRICS_FILE
        kept: list[dict[str, Any]] = []
        self.removed = 0
        """The number of rows that were removed."""
        try:
            if table.exists():
                rows = read_rows(table) + _cut_off_rows(table)
                kept = [
                    row
                    for row in rows
                    if row[ENV_STEPS_KEY] <= from_env_steps and (row.get(UPDATES_KEY) or 0) <= from_update
                ]
                self.removed = len(rows) - len(kept)
                write_atomically(table, lambda file: file.writelines(_json_line(row) for row in kept))
            self._table = RecordFile(folder, METRICS_FILE)
        except OSError as error:
            raise RunError(f"{error.filename or table} cannot be written: {error.strerror}") from error
        self._newest: Row = kept[-1] if kept else {}

    @property
    def gone(self) -> bool:
        """Whether metrics.jsonl was deleted, or its folder renamed, since the last row was written. `flush` recreates it."""
        return self._table.gone

    def write(self, progress: Progress, train: Row) -> None:
        """Add a row, which `flush` writes. `train` are the metrics of the algorithm, of an evaluation, or of callbacks.

        If the newest row belongs to the same update, the metrics are added to that row, or to a copy of it if it has the
        evaluation of another policy.
        """
        row: Row = progress.row(train)
        newest = self._newest
        if not newest or _update(newest) != _update(row):
            self._table.append(_json_line(row))
        elif EVALUATION_KEY in newest and EVALUATION_KEY in row and _evaluated(newest) != _evaluated(row):
            row = {name: number for name, number in newest.items() if not name.startswith("eval/")} | named(train)
            self._table.append(_json_line(row))
        else:
            row = {**newest, **named(train)}
            self._table.replace(_json_line(newest), _json_line(row))
        self._newest = row

    def flush(self) -> None:
        """Write the rows that are not written yet. Raises `RunError`, with a one-line message, if that fails.

        Earlier rows then stay readable, and the next call tries again.
        """
        self._table.flush()

    def sync(self) -> None:
        """Like `flush`, but also waits until the rows are on the disk. Called before a checkpoint of their updates."""
        self._table.sync()

    def close(self) -> None:
        """Write the remaining rows if possible, and close the file."""
        with suppress(RunError):
            self.flush()
        self._table.close()


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a metrics.jsonl, each of which has its env steps. Ignores a last line that was cut off.

    Other unreadable rows are left out, and the log says how many. Raises OSError.
    """
    rows, unreadable = read_and_count_rows(path)
    if unreadable:
        log.warning("%s: %d of %d rows cannot be read; they are left out", path, unreadable, len(rows) + unreadable)
    return rows


def read_and_count_rows(path: Path) -> tuple[list[dict[str, Any]], int]:
    """The readable rows, and the number of unreadable ones. A last line that was cut off is ignored. Raises OSError."""
    *lines, _ = read(path, MOST_BYTES).split(b"\n")
    rows = [row for line in lines if (row := decoded_row(line)) is not None]
    return rows, len(lines) - len(rows)


def _update(row: Row) -> tuple[Any, Any]:
    """The number of the update to which a row belongs, and its env steps."""
    return row.get(UPDATES_KEY), row[ENV_STEPS_KEY]


def _evaluated(row: Row) -> Any:
    """The env steps of the policy to which the evaluation in a row belongs."""
    return row.get(EVALUATED_AT_KEY, row[ENV_STEPS_KEY])


_DECODER = msgspec.json.Decoder(dict[str, int | float | None])


def decoded_row(line: bytes) -> dict[str, Any] | None:
    """Decode a row of finite numbers or nulls, by name. Returns None if it cannot be read."""
    try:
        row = _DECODER.decode(line)
        msgspec.convert(row[ENV_STEPS_KEY], Natural)
        if not all(number is None or math.isfinite(number) for number in row.values()):
            return None
    except (*INVALID, KeyError, OverflowError):
        return None
    return row


def _cut_off_rows(path: Path) -> list[dict[str, Any]]:
    """The last row, if its end is missing, with the numbers before the point where it is cut off. Raises OSError.

    Empty if the last row is complete, or if it isn't known to which update it belongs.
    """
    with os.fdopen(open_regular(path), "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - MOST_LINE_BYTES - 2))  # one byte more than the longest line has
        content = file.read()
    line = content.removesuffix(b"\n").rpartition(b"\n")[2]
    if len(line) > MOST_LINE_BYTES:
        return []
    row = decoded_row(line)
    if row is not None and content.endswith(b"\n"):
        return []
    for _ in range(MOST_COMMAS):
        if row is not None:
            break
        line = line.rpartition(b",")[0]  # without the last number, which may lack digits
        row = decoded_row(line + b"}")
    return [row] if row is not None and UPDATES_KEY in row else []


def _json_line(row: Row) -> bytes:
    return msgspec.json.encode(row) + b"\n"
