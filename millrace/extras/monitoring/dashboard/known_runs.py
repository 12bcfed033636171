"""The runs that the dashboard shows, reread from their folders when files have changed.

Rule: unchanged files are not read again, and only a bounded number of rows of a long metrics.jsonl is kept. Addresses of
pages contain a run's key instead of its path.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

from millrace.extras.monitoring.report.metrics_tail import MetricsTail
from millrace.extras.monitoring.report.reported_runs import ReportedRun, read_run
from millrace.learner.run_folder.json_log import RUN_LOG_FILE
from millrace.learner.run_folder.metrics_log import METRICS_FILE
from millrace.learner.run_folder.progress_file import PROGRESS_FILE
from millrace.learner.run_folder.regular_files import open_regular, reason, regular_files
from millrace.learner.run_folder.results import SUMMARY_FILE
from millrace.learner.run_folder.run_format import CONFIG_FILE, RUN_FILE, is_run_folder
from millrace.learner.run_folder.run_lock import LOCK_FILE
from millrace.learner.run_lines import RunLine, find_runs, read_line
from millrace.protocol.arrays import Doubles
from millrace.protocol.bounds import escaped
from millrace.protocol.errors import UsageError

CHANGES = ("", CONFIG_FILE, RUN_FILE, PROGRESS_FILE, SUMMARY_FILE, METRICS_FILE, RUN_LOG_FILE, "videos")
MOST_KEPT = 64  # largest number of runs whose rows are in memory
MOST_LOGS = 4
LOG_BYTES = 4_096


class RunContent(NamedTuple):
    """The content of a run folder, with its rows of metrics."""

    report: ReportedRun
    rows: list[dict[str, Any]]
    evaluations: Doubles
    """see `MetricsTail.evaluations`"""


class KnownRuns:
    """Finds and reads runs. Used by one thread."""

    def __init__(self, folders: Sequence[Path], clock: Callable[[], float]) -> None:
        """`clock`: returns the time in seconds since 1970."""
        self._folders = folders
        self._clock = clock
        self._tails: dict[Path, MetricsTail] = {}
        self._read: dict[Path, tuple[object, RunContent]] = {}
        self._lines: dict[Path, tuple[object, RunLine]] = {}

    @property
    def only(self) -> Path | None:
        """The run folder, if the dashboard shows only this one."""
        return self._folders[0] if len(self._folders) == 1 and is_run_folder(self._folders[0]) else None

    def find(self) -> dict[str, Path]:
        """The runs by their keys, the newest first. Folders that no longer exist are skipped."""
        runs: list[Path] = []
        for folder in self._folders:
            try:
                runs += find_runs([folder])
            except UsageError:
                continue
        return {key_of(run): run for run in runs}

    def line(self, run: Path) -> RunLine:
        """A run's line in a list of runs."""
        now = self._clock()
        changed = _changes(run)
        before, line = self._lines.get(run, (None, None))
        if line is None or before != changed or line.owner is not None or (run / LOCK_FILE).exists():
            line = read_line(run, now)
            self._lines[run] = changed, line
        return line

    def content(self, run: Path) -> RunContent:
        """The parts of this run's folder that the run's page shows.

        Raises `UsageError`, with a one-line message, if the folder can't be read.
        """
        changed = _changes(run)
        before, content = self._read.pop(run, (None, None))
        if content is None or before != changed:
            tail = self._tails.setdefault(run, MetricsTail(run))
            try:
                tail.read()
            except FileNotFoundError:
                tail = MetricsTail(run)
            except OSError as error:
                raise UsageError(f"run {run}: {METRICS_FILE} cannot be read: {reason(error)}") from error
            rows = tail.rows
            content = RunContent(read_run(run, rows), rows, tail.evaluations)
        self._read[run] = changed, content  # added at the end, so the first run is the least recently requested one
        while len(self._read) > MOST_KEPT:
            oldest = next(iter(self._read))
            del self._read[oldest]
            self._tails.pop(oldest, None)
        return content


def key_of(run: Path) -> str:
    """The key that stands for a run in addresses: 12 hexadecimal digits."""
    return blake2b(os.fsencode(run.absolute()), digest_size=6).hexdigest()


def newest_logs(run: Path) -> list[tuple[str, str]]:
    """The names and last lines of local workers' logs, the most recently written first."""
    logs = regular_files(run, "workers/*.log")
    ends_of_logs = []
    for path in sorted(logs, key=_written, reverse=True)[:MOST_LOGS]:
        try:
            with os.fdopen(open_regular(path), "rb") as file:
                file.seek(max(0, os.fstat(file.fileno()).st_size - LOG_BYTES))
                content = file.read(LOG_BYTES)
        except OSError:
            continue
        *_, lines = content.partition(b"\n") if len(content) == LOG_BYTES else (content,)
        if lines.strip():
            ends_of_logs.append((path.name, escaped(lines.decode(errors="replace")).rstrip()))
    return ends_of_logs


def _written(path: Path) -> int:
    try:
        return path.lstat().st_mtime_ns
    except OSError:
        return 0


def _changes(run: Path) -> tuple[object, ...]:
    """A value that changes whenever one of the run's files is written."""
    stamps: list[object] = []
    for name in CHANGES:
        try:
            stat = (run / name).lstat()
            stamps.append((stat.st_ino, stat.st_size, stat.st_mtime_ns))
        except OSError:
            stamps.append(None)
    return tuple(stamps)
