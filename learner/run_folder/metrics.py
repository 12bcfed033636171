"""What is measured while a run goes on, and where it is written: metrics.jsonl and TensorBoard.

Names are those of Stable-Baselines3 where it has one; the x axis is env steps. A run that is resumed takes back the rows
that its checkpoint knows nothing of, so a curve never goes over the same steps twice.
"""

from __future__ import annotations

import errno
import io
import math
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from learner.run_folder.atomic_write import write_atomically
from protocol.errors import RunError
from protocol.rollout import Episode

WINDOW = 100
X = "time/total_timesteps"
EVENTS_EVERY_S = 0.2  # a fast run makes a hundred updates in that time, and an event takes as long as a small minibatch
Row = Mapping[str, float | None]


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """How far a run is: what the terminal shows and the metrics record after each update."""

    run: str = ""
    """the run folder"""
    env_steps: int = 0
    total_steps: int = 0
    updates: int = 0
    wall_s: float = 0.0
    steps_per_s: float = 0.0
    return_mean: float | None = None
    """of the last 100 episodes, raw rewards; None before the first has ended"""
    length_mean: float | None = None
    lag_mean: float = 0.0
    lag_max: int = 0
    workers_alive: int = 0
    workers_expected: int = 0
    ledger: dict[str, int] = {}
    """tickets and transitions by what became of them"""
    stages: dict[str, float] = {}
    """seconds the learner has spent in each stage so far"""
    note: str = ""
    """something to tell the user, in one line"""

    def row(self, train: Mapping[str, float]) -> dict[str, float | None]:
        """One flat row of metrics, with those of the algorithm."""
        row: dict[str, float | None] = {
            "rollout/ep_rew_mean": self.return_mean,
            "rollout/ep_len_mean": self.length_mean,
            "time/fps": self.steps_per_s,
            "time/iterations": self.updates,
            "time/time_elapsed": self.wall_s,
            X: self.env_steps,
            "lag/mean": self.lag_mean,
            "lag/max": self.lag_max,
            "drop/stale": self.ledger.get("stale", 0),
        }
        row |= {f"ledger/{name}": count for name, count in self.ledger.items()}
        row |= {f"stage/{name}": seconds for name, seconds in self.stages.items()}
        return row | {name if "/" in name else f"train/{name}": value for name, value in train.items()}


class Evaluation(msgspec.Struct, frozen=True, kw_only=True):
    """What greedy episodes gave, in raw rewards."""

    episodes: int
    return_mean: float
    return_std: float
    """population standard deviation over the episodes"""
    length_mean: float
    cut: int = 0
    """episodes that did not end by themselves, and were counted as they stood"""

    def __str__(self) -> str:
        cut = f", {self.cut} of them cut short" if self.cut else ""
        return f"return {self.return_mean:.1f} ± {self.return_std:.1f} over {self.episodes} episodes{cut}"

    def metrics(self) -> dict[str, float]:
        """By the names users know, to be written with a row."""
        return {"eval/mean_reward": self.return_mean, "eval/mean_ep_length": self.length_mean}


class EpisodeWindow:
    """The last 100 episodes."""

    def __init__(self, episodes: Iterable[Episode] = ()) -> None:
        self._episodes: deque[Episode] = deque(episodes, maxlen=WINDOW)

    def extend(self, episodes: Iterable[Episode]) -> None:
        """Add episodes that have just ended, in order."""
        self._episodes.extend(episodes)

    @property
    def full(self) -> bool:
        """True once there are 100."""
        return len(self._episodes) == WINDOW

    @property
    def return_mean(self) -> float | None:
        """Mean return, or None before the first episode has ended."""
        return float(np.mean([episode.reward for episode in self._episodes])) if self._episodes else None

    @property
    def length_mean(self) -> float | None:
        """Mean length in env steps, or None."""
        return float(np.mean([episode.length for episode in self._episodes])) if self._episodes else None

    def state(self) -> list[Any]:
        """As plain data, for a checkpoint."""
        state: list[Any] = msgspec.to_builtins(list(self._episodes))
        return state

    @staticmethod
    def of_state(state: list[Any]) -> EpisodeWindow:
        """As it was."""
        return EpisodeWindow(msgspec.convert(state, list[Episode]))


class MetricsLog:
    """The two files that rows go to: all to the table; to TensorBoard's those a while apart, evaluations, and the last."""

    def __init__(self, folder: Path, from_env_steps: int = 0, clock: Callable[[], float] = time.monotonic) -> None:
        """`from_env_steps`: rows beyond it, of a run that is resumed, are taken back."""
        table = folder / "metrics.jsonl"
        if table.exists():
            kept = [row for row in read_rows(table) if (row.get(X) or 0) <= from_env_steps]
            write_atomically(table, lambda file: file.writelines(_line(row) for row in kept))
        events = folder / "tensorboard" / f"events.out.tfevents.{time.time_ns()}.{socket.gethostname()}.{os.getpid()}"
        events.parent.mkdir(exist_ok=True)
        self._table, self._events = _Appender(table), _Appender(events)
        self._events.append(_first_event(from_env_steps))
        self._clock, self._told_s = clock, -math.inf
        self._untold: tuple[Row, int] | None = None

    def write(self, progress: Progress, train: Mapping[str, float]) -> None:
        """Add a row. Raises `RunError` in one line when the disk does not take it; what is there stays readable."""
        row = progress.row(train)
        self._table.append(_line(row))
        self._untold = row, progress.env_steps
        if self._clock() - self._told_s >= EVENTS_EVERY_S or any(name.startswith("eval/") for name in row):
            self._tell()

    def _tell(self) -> None:
        if self._untold is not None:
            untold, self._untold = self._untold, None
            self._told_s = self._clock()
            self._events.append(_event(*untold))

    def close(self) -> None:
        """Close both."""
        with suppress(RunError):  # the table has it
            self._tell()
        self._table.close()
        self._events.close()


class _Appender:
    """A file that grows by whole records: what a full disk cut off is taken back."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("ab", buffering=0)
        self._bytes = path.stat().st_size

    def append(self, record: bytes) -> None:
        try:
            if self._file.write(record) != len(record):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(self._bytes)
            raise RunError(f"{self._path}: a row was not written: {error.strerror}") from error
        self._bytes += len(record)

    def close(self) -> None:
        self._file.close()


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a metrics.jsonl; a last line that was cut off is left out."""
    lines = path.read_bytes().splitlines(keepends=True)
    return [msgspec.json.decode(line, type=dict[str, Any]) for line in lines if line.endswith(b"\n")]


def _line(row: Row) -> bytes:
    return msgspec.json.encode(row) + b"\n"


def _event(row: Row, env_steps: int) -> bytes:
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.proto.summary_pb2 import Summary

    values = [Summary.Value(tag=name, simple_value=number) for name, number in row.items() if number is not None]
    return _record(Event(wall_time=time.time(), step=env_steps, summary=Summary(value=values)))


def _first_event(env_steps: int) -> bytes:
    """The head of an events file; in a run that is resumed, TensorBoard then forgets what it read beyond these steps."""
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog

    head = _record(Event(wall_time=time.time(), file_version="brain.Event:2"))
    if not env_steps:
        return head
    start = SessionLog(status=SessionLog.START)
    return head + _record(Event(wall_time=time.time(), step=env_steps + 1, session_log=start))


def _record(event: Any) -> bytes:
    """In TensorBoard's framing: length, its checksum, the event, its checksum. TensorBoard's own writer is a thread."""
    from tensorboard.summary.writer.record_writer import RecordWriter

    framed = io.BytesIO()
    RecordWriter(framed).write(event.SerializeToString())
    return framed.getvalue()
