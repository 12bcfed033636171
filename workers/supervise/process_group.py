"""The end of a worker's session: of the worker, and of what its environment has started.

Rule: a process is gone when it holds no port and no file any more. A zombie is, even if nobody ever reaps it. The ranks of
an MPI program have process groups of their own, and stay in the session.
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
            # With the state Z, its first thread has ended; others may hold its files yet.
            if str(leader) in fields[2:4] and (fields[0] not in "ZX" or int(fields[17]) > 1):
                pids.append(int(name))
    return pids


def kill(pids: Iterable[int]) -> None:
    """SIGKILL to these processes, as far as they live and are ours."""
    for pid in pids:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)


def process_stat(pid: int) -> list[str]:
    """The fields of /proc/PID/stat behind the name, from the state on; none if there is no such process or no /proc."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []
