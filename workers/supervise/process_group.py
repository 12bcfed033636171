"""Finds, measures and ends the processes of a worker's session: the worker, and what its environment has started.

Rule: a process counts as gone when it no longer holds any port or file, so a zombie counts as gone, even if it is never
reaped. Processes are also found by session, because the ranks of an MPI program have their own process groups but stay in
the session.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

THREADS, RSS = 17, 21  # indices of fields of `process_stat`


def live_members(leader: int) -> list[int]:
    """The processes in the process group or session of `leader` that are not gone, including the leader itself.

    On a system without /proc, none is found.
    """
    # State Z means that the first thread of a process has ended; other threads may still hold its files.
    return [
        pid
        for pid, fields in _processes()
        if str(leader) in fields[2:4] and (fields[0] not in "ZX" or int(fields[THREADS]) > 1)
    ]


class SessionUse(NamedTuple):
    """The resources of this machine that a process group or session uses at one moment."""

    computes: bool = False
    """whether a thread runs, or is ready to run"""
    resident: int = 0
    """bytes of memory; shared memory counts in each process"""


def use_of_sessions(leaders: Collection[int]) -> dict[int, SessionUse]:
    """What the process groups or sessions of these leaders use now; those without a process are left out.

    Reads all of /proc once. On a system without /proc, all are left out.
    """
    used: dict[int, SessionUse] = {}
    for pid, fields in _processes():
        leader = next((int(field) for field in fields[2:4] if int(field) in leaders), None)
        if leader is not None:
            before = used.get(leader, SessionUse())
            resident = before.resident + int(fields[RSS]) * os.sysconf("SC_PAGE_SIZE")
            used[leader] = SessionUse(before.computes or "R" in _thread_states(pid), resident)
    return used


def _processes() -> Iterator[tuple[int, list[str]]]:
    """All processes and their `process_stat`; none on a system without /proc."""
    with suppress(FileNotFoundError):
        for name in filter(str.isdecimal, os.listdir("/proc")):
            if fields := process_stat(int(name)):
                yield int(name), fields


def _thread_states(pid: int) -> Iterator[str]:
    """The state of each thread of a process: R if it runs or is ready to run."""
    with suppress(OSError):  # the process has ended
        for thread in os.listdir(f"/proc/{pid}/task"):
            yield from process_stat(pid, thread)[:1]


def kill(pids: Iterable[int]) -> None:
    """Send SIGKILL to these processes. Those that are gone, or belong to another user, are skipped."""
    for pid in pids:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)


def process_stat(pid: int, thread: str = "") -> list[str]:
    """The fields of /proc/PID/stat that follow the name, from the state on; empty if there is no such process
    or no /proc. With `thread`, those of one of the process's threads.
    """
    where = f"/proc/{pid}/task/{thread}/stat" if thread else f"/proc/{pid}/stat"
    try:
        return Path(where).read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []
