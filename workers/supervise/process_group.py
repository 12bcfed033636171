"""Ends a worker's session: the worker, and the processes that its environment has started.

Rule: a process is gone when it doesn't hold any port or file any more. This includes a zombie, even if nobody ever reaps it.
The ranks of an MPI program have their own process groups, but stay in the session.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path


def live_members(leader: int) -> list[int]:
    """The processes of a leader's group and session that are not gone, itself included. Without /proc, none is found."""
    pids = []
    with suppress(FileNotFoundError):
        for name in filter(str.isdecimal, os.listdir("/proc")):
            fields = process_stat(int(name))
            # State Z means that its first thread has ended; other threads may still hold its files.
            if str(leader) in fields[2:4] and (fields[0] not in "ZX" or int(fields[17]) > 1):
                pids.append(int(name))
    return pids


def kill(pids: Iterable[int]) -> None:
    """Send SIGKILL to those of these processes that live and belong to this user."""
    for pid in pids:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)


def process_stat(pid: int) -> list[str]:
    """The fields of /proc/PID/stat behind the name, from the state on; none if there is no such process or no /proc."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []
