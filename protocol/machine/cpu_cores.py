"""The number of cores that this process may use: its CPU affinity, or the CPU quota of its job or container if lower."""

from __future__ import annotations

import os
from pathlib import Path

from millrace.protocol.machine.control_groups import cpu_quota


def usable_cores(system: Path = Path("/")) -> int:
    """The number of cores that this process may use, at least 1. `system` is the folder that stands for `/`."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, int(min(allowed, cpu_quota(system))))
