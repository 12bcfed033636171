"""Ends a worker's session: the worker, and the processes that its environment has started.

Rule: a process counts as gone when it no longer holds any port or file. So a zombie counts as gone, even if it is never
reaped.
Processes are found by session too, because the ranks of an MPI program have their own process groups but stay in the
session.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path


def live_members(leader: int) -> list[int]:
    """The processes in the process group or session of `leader` that are not gone, including the leader itself.

    On a system without /proc, none is found.
    """
    pids = []
    with suppress(FileNotFoundError):
        for name in filter(str.isdecimal, os.listdir("/proc")):
            fields = process_stat(int(name))
            # State Z means that the first thread of a process has ended; other threads may still hold its files.
            if str(leader) in fields[2:4] and (fields[0] not in "ZX" or int(fields[17]) > 1):
                pids.append(int(name))
    return pids


def kill(pids: Iterable[int]) -> None:
    """Send SIGKILL to these processes. Those that are gone, or belong to another user, are skipped."""
    for pid in pids:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)


def process_stat(pid: int) -> list[str]:
    """The fields of /proc/PID/stat that follow the name, from the state on; empty if there is no such process
    or no /proc.
    """
    try:
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []
