"""How many cores this process may use: those it may run on, or its container's share of them, if that is less."""

from __future__ import annotations

import os
from pathlib import Path

CPU_MAX = Path("/sys/fs/cgroup/cpu.max")  # control groups, version 2: microseconds of CPU in a period, or "max"; the period


def usable_cores() -> int:
    """At least 1."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(allowed, int(_share(CPU_MAX, allowed))))


def _share(cpu_max: Path, otherwise: float) -> float:
    """Of CPU time, in cores."""
    try:
        quota, period = cpu_max.read_text().split()
        return float(quota) / float(period)
    except (OSError, ValueError, ZeroDivisionError):  # none, or "max"
        return otherwise
