"""A wrapper that records the wall time and CPU time of each step and reset of an env copy, and its memory.

Rule: it changes nothing that the environment gets or returns. It runs in the worker's process, and writes its notes to a
file for each copy, so that the notes can be read even if the copy crashed or hung.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from millrace.protocol.arrays import Array, Doubles
from millrace.protocol.envs.seats import has_seats
from millrace.protocol.machine.core_delay import CoreDelay
from millrace.workers.supervise.process_group import RSS, live_members, process_stat

STEP, RESET, PROCESSES = 0.0, 1.0, 2.0  # kinds of notes
FLUSH_S = 0.25
UTIME, STIME = 11, 12  # indices of fields of `process_stat`


class Notes:
    """Writes the notes of one copy. A note is a row of 5 numbers (float64).

    For a step or reset: the kind, the time of its beginning (monotonic), its wall seconds, CPU seconds of this process, and
    the seconds in which it was ready to run but had no core. For `PROCESSES`: the kind, the time, 0, the CPU seconds so far
    of the other processes in the worker's session, and the memory of the whole session in bytes.
    """

    def __init__(self, folder: str) -> None:
        self._file = (Path(folder) / f"{os.getpid()}-{id(self):x}").open("ab", 0)
        self._delay = CoreDelay()
        self._rows: list[float] = []
        self._calls = 0
        self._flush_at_s = time.monotonic() + FLUSH_S
        self._look_after_s = FLUSH_S
        self._looked_at_s = time.monotonic()

    def timed(self, kind: float, call: Callable[[], Any]) -> Any:
        """Time a call, and return its result. A call that raises is also noted."""
        delay_s = self._delay.seconds()
        cpu_s = time.process_time()
        began_s = time.monotonic()
        try:
            return call()
        finally:
            ended_s = time.monotonic()
            cpu_s = time.process_time() - cpu_s
            self._rows += (kind, began_s, ended_s - began_s, cpu_s, self._delay.seconds() - delay_s)
            self._calls += 1
            # Also write after 1, 2, 4, 8, … calls, so that there are notes even if the copy crashes early.
            if ended_s > self._flush_at_s or self._calls & (self._calls - 1) == 0:
                self._flush(ended_s)

    def close(self) -> None:
        """Write the remaining notes."""
        self._look(time.monotonic())
        self._flush(time.monotonic())
        self._file.close()
        self._delay.close()

    def _flush(self, now_s: float) -> None:
        if now_s - self._looked_at_s >= self._look_after_s:  # at growing intervals, because it reads all of /proc
            self._look(now_s)
            self._look_after_s *= 2
        self._file.write(np.array(self._rows).tobytes())
        self._rows.clear()
        self._flush_at_s = now_s + FLUSH_S

    def _look(self, now_s: float) -> None:
        self._looked_at_s = now_s
        own = os.getpid()
        cpu_s = 0.0
        pages = 0
        for pid in live_members(os.getsid(0)):
            fields = process_stat(pid)
            if len(fields) > RSS:
                pages += int(fields[RSS])
                if pid != own:
                    cpu_s += (int(fields[UTIME]) + int(fields[STIME])) / os.sysconf("SC_CLK_TCK")
        self._rows += (PROCESSES, now_s, 0.0, cpu_s, float(pages * os.sysconf("SC_PAGE_SIZE")))


class _Timed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Times a gymnasium environment."""

    def __init__(self, env: gymnasium.Env[Any, Any], notes: Notes) -> None:
        super().__init__(env)
        self._notes = notes

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self._notes.timed(RESET, lambda: self.env.reset(seed=seed, options=options))

    def step(self, action: Any) -> Any:
        return self._notes.timed(STEP, lambda: self.env.step(action))

    def close(self) -> None:
        self._notes.close()
        super().close()


class _TimedAgents:
    """Times an environment of several agents that has one of PettingZoo's interfaces."""

    def __init__(self, env: Any, notes: Notes) -> None:
        self.env = env
        self._notes = notes

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # `env` isn't set yet, so getattr(self.env, …) would recurse
            raise AttributeError(name)
        return getattr(self.env, name)

    def reset(self, *args: Any, **kwargs: Any) -> Any:
        return self._notes.timed(RESET, lambda: self.env.reset(*args, **kwargs))

    def step(self, action: Any) -> Any:
        return self._notes.timed(STEP, lambda: self.env.step(action))

    def close(self) -> None:
        self._notes.close()
        self.env.close()


def stopwatch(env: Any, folder: str) -> Any:
    """Wrap the environment so that its calls are noted in a file in this folder."""
    notes = Notes(folder)
    return _TimedAgents(env, notes) if has_seats(env) else _Timed(env, notes)


class CopyTimes(NamedTuple):
    """The times of one copy's steps and resets, and its memory."""

    steps: Doubles
    """[steps, 4]: time of the beginning, wall seconds, CPU seconds of the worker's process, seconds ready without a core"""
    resets: Doubles
    """[resets, 4]: the same numbers for resets"""
    processes: Doubles
    """[samples, 3]: time, CPU seconds so far of the processes that the copy has started, bytes of all processes"""

    @property
    def others_cpu_share(self) -> float:
        """How many cores the processes that the copy has started kept busy, on average."""
        if len(self.processes) < 2:
            return 0.0
        first, last = self.processes[0], self.processes[-1]
        return float((last[1] - first[1]) / max(last[0] - first[0], 1e-9))

    @property
    def bytes(self) -> int:
        """The largest amount of memory that was measured."""
        return int(self.processes[:, 2].max()) if len(self.processes) else 0


def read_notes(folder: Path) -> list[CopyTimes]:
    """The times of all copies whose notes are in this folder."""
    return [_times(np.fromfile(path)) for path in sorted(folder.iterdir())]


def _times(numbers: Array) -> CopyTimes:
    rows = numbers[: len(numbers) // 5 * 5].reshape(-1, 5)
    # A call may be interrupted just before its wall time begins. Then the delay exceeds the waiting time, so clip the delay.
    kinds = rows[:, 0]
    rows[:, 4] = np.where(kinds == PROCESSES, rows[:, 4], np.clip(rows[:, 4], 0.0, np.maximum(0.0, rows[:, 2] - rows[:, 3])))
    calls = rows[:, 1:]
    return CopyTimes(calls[kinds == STEP], calls[kinds == RESET], rows[kinds == PROCESSES][:, [1, 3, 4]])
