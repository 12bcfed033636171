"""The number of cores that this process may use: its CPU affinity, or the CPU quota of its container if that is less."""

from __future__ import annotations

import os
from pathlib import Path

CPU_MAX = Path("/sys/fs/cgroup/cpu.max")  # control groups, version 2: microseconds of CPU in a period, or "max"; the period


def usable_cores() -> int:
    """Number of cores, at least 1."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(allowed, int(_cpu_quota(CPU_MAX, allowed))))


def _cpu_quota(cpu_max: Path, otherwise: float) -> float:
    """The container's CPU quota, in cores; `otherwise` if there is none."""
    try:
        quota, period = cpu_max.read_text().split()
        return float(quota) / float(period)
    except (OSError, ValueError, ZeroDivisionError):  # none, or "max"
        return otherwise
