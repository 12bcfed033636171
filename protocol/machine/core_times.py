"""For how much of its time each core that this process may use was idle, as Linux counts it.

Rule: a core whose processes wait for a disk counts as idle, because it could run another process meanwhile.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

COUNTED = 8  # the times user, nice, system, idle, iowait, irq, softirq and steal; user contains those that follow in a line
IDLE, IOWAIT = 3, 4


class CoreTimes(NamedTuple):
    """Time of these cores together since the machine was started, in units of the kernel's clock."""

    idle: int = 0
    total: int = 0


def core_times(system: Path = Path("/")) -> CoreTimes:
    """The times up to now; zeros if the system doesn't count them. `system` is the folder that stands for `/`."""
    try:
        lines = (system / "proc/stat").read_text().splitlines()
    except OSError:
        return CoreTimes()
    ours = {f"cpu{core}" for core in os.sched_getaffinity(0)}
    rows = [line.split()[: 1 + COUNTED] for line in lines if line.partition(" ")[0] in ours]
    times = [[int(field) for field in fields] for _, *fields in rows]
    return CoreTimes(sum(each[IDLE] + each[IOWAIT] for each in times), sum(map(sum, times)))


def idle_share(before: CoreTimes, after: CoreTimes) -> float:
    """The share of the time between two readings for which the cores were idle; 0 if the system doesn't count the times."""
    total = after.total - before.total
    return (after.idle - before.idle) / total if total > 0 else 0.0
