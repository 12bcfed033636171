"""Reads a growing metrics.jsonl, each time from where the last read ended, and keeps a bounded number of its rows.

Rule: from a long file, it keeps evenly spaced rows, rows with an evaluation (all of these while there are few), and the
newest row. For every evaluation, it keeps three numbers, so that the best one is known. The newest row is read again each
time, because a run may add numbers to it. If the file was replaced, for example by a resume, it is read from the beginning.
"""

from __future__ import annotations

import errno
import math
import os
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from millrace.extras.monitoring.report.curve import evaluated_at
from millrace.learner.run_folder.metrics_log import METRICS_FILE, MOST_LINE_BYTES, decoded_row
from millrace.learner.run_folder.regular_files import MOST_BYTES, open_regular
from millrace.learner.run_folder.results import EVALUATION_KEY, EVALUATION_LENGTH_KEY
from millrace.protocol.arrays import Doubles, Ints

MOST_ROWS = 256  # at least this many rows of a long file are kept, and at most twice as many; a chart has 500 points
CHUNK_BYTES = 1 << 22
NEWLINE = 10
OF_AN_EVALUATION = b'"%s"' % EVALUATION_KEY.encode()


class MetricsTail:
    """The rows of metrics of one run."""

    def __init__(self, run: Path, most: int = MOST_ROWS) -> None:
        self._path = run / METRICS_FILE
        self._most = most
        self._seen: tuple[int, ...] = ()  # inode, size and modification time of the file
        self._newest: bytes | None = None
        self._begin_anew()

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The kept rows, in order."""
        lines = self._all.lines | self._evaluations.lines
        if self._newest is not None:
            lines[self._all.count] = self._newest
        return [row for _, line in sorted(lines.items()) if (row := decoded_row(line)) is not None]

    @property
    def evaluations(self) -> Doubles:
        """All evaluations, in order: [K, 3] env steps of the evaluated policy, mean return, mean episode length or NaN."""
        newest = None if self._newest is None else decoded_row(self._newest)
        numbers = self._evaluated + array("d", [] if newest is None else _evaluation(newest))
        return np.array(numbers).reshape(-1, 3)

    def read(self) -> bool:
        """Read the rows that were added since the last read. Returns whether the file has changed. Raises OSError."""
        with os.fdopen(open_regular(self._path), "rb") as file:
            status = os.fstat(file.fileno())
            seen = status.st_ino, status.st_size, status.st_mtime_ns
            if seen == self._seen:
                return False
            if status.st_size > MOST_BYTES:
                raise OSError(errno.EFBIG, f"expected at most {MOST_BYTES:,} bytes, got {status.st_size:,}", str(self._path))
            if self._seen[:1] != seen[:1] or status.st_size < self._offset:
                self._begin_anew()
            file.seek(self._offset)
            self._newest = None
            rest = b""
            while chunk := file.read(CHUNK_BYTES):
                rest = self._add(rest + chunk)
        self._seen = seen
        return True

    def _begin_anew(self) -> None:
        self._offset = 0  # offset in the file at which the newest whole row begins
        self._newest = None
        self._all = _Thinned(self._most)
        self._evaluations = _Thinned(self._most)
        self._evaluated = array("d")  # three numbers for each evaluation

    def _add(self, text: bytes) -> bytes:
        """Add the lines of this text, except the newest whole line, which may change. Returns the text from that line on."""
        ends = np.flatnonzero(np.frombuffer(text, np.uint8) == NEWLINE)
        begins = np.concatenate([[0], ends + 1])
        if np.diff(begins, append=len(text)).max() > MOST_LINE_BYTES:
            raise OSError(errno.EFBIG, f"a row has more than {MOST_LINE_BYTES:,} bytes", str(self._path))
        if not ends.size:
            return text
        self._newest = text[begins[-2] : ends[-1]]
        first = self._all.count
        spans = np.column_stack([begins[:-2], ends[:-1]])
        lines = np.unique(np.searchsorted(ends, [*_places(text, OF_AN_EVALUATION)]))
        evaluations = lines[lines < len(spans)]
        for begin, end in spans[evaluations].tolist():
            self._evaluated.extend(_evaluation(decoded_row(text[begin:end]) or {}))
        self._evaluations.add(text, first, spans, evaluations)
        self._all.add(text, first, spans, np.arange(len(spans)))
        self._offset += int(begins[-2])
        return text[begins[-2] :]


class _Thinned:
    """Keeps at most `2 * most` of the lines that are added, at equal intervals."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._every = 1
        self.count = 0  # number of lines that were added
        self.lines: dict[int, bytes] = {}  # the kept lines, by their numbers in the file

    def add(self, text: bytes, first: int, spans: Ints, which: Ints) -> None:
        """Add lines of a text.

        `spans`: [lines, 2] begin and end of each line in the text. `which`: indices of the lines to add. `first`: the number
        of the text's first line in the file.
        """
        before = self.count
        every = self._every
        self.count += len(which)
        while self.count > 2 * self._most * self._every:
            self._every *= 2
        if self._every > every:
            self.lines = dict([*self.lines.items()][:: self._every // every])
        for i in which[-before % self._every :: self._every].tolist():
            begin, end = spans[i]
            self.lines[first + i] = text[begin:end]


def _evaluation(row: Mapping[str, Any]) -> Sequence[float]:
    """The env steps, return and episode length of the row's evaluation; empty if it has none."""
    if (returned := row.get(EVALUATION_KEY)) is None or (at := evaluated_at(row)) is None:
        return ()
    length = row.get(EVALUATION_LENGTH_KEY)
    return at, returned, math.nan if length is None else length


def _places(text: bytes, part: bytes) -> Iterator[int]:
    """The offsets at which `part` occurs in the text."""
    place = text.find(part)
    while place >= 0:
        yield place
        place = text.find(part, place + 1)
