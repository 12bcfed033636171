"""The end of a worker's process group: of the worker, and of what its environment has started.

Rule: a process is gone when it holds no port and no file any more. A zombie is, even if nobody ever reaps it.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def live_members(group: int) -> list[int]:
    """The processes of a group that are not gone. Reads /proc only if the group exists; without /proc, none is found."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return []
    except PermissionError:  # all of another user: /proc knows
        pass
    found = []
    with suppress(FileNotFoundError):
        for name in filter(str.isdecimal, os.listdir("/proc")):
            fields = process_stat(int(name))
            # With the state Z, its first thread has ended; others may hold its files yet.
            if fields and int(fields[2]) == group and (fields[0] not in "ZX" or int(fields[17]) > 1):
                found.append(int(name))
    return found


def process_stat(pid: int) -> list[str]:
    """The fields of /proc/PID/stat behind the name, from the state on; none if there is no such process or no /proc."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []
