"""How much memory is left: of this machine, or of the container that bounds it. Reads the system's own files, no more."""

from __future__ import annotations

from pathlib import Path

MEMINFO = Path("/proc/meminfo")
CGROUP = Path("/sys/fs/cgroup")
CGROUPS = (
    (CGROUP / "memory.max", CGROUP / "memory.current", CGROUP / "memory.stat", "inactive_file"),
    (
        CGROUP / "memory/memory.limit_in_bytes",
        CGROUP / "memory/memory.usage_in_bytes",
        CGROUP / "memory/memory.stat",
        "total_inactive_file",
    ),
)
"""version 2, version 1: the bound, what is used, and of that the cached files that would be given back"""
GIB = 2**30


def available_bytes() -> int | None:
    """What can still be taken without swapping, or None where the system does not say."""
    found = [_of_machine(), *(_of_container(*paths) for paths in CGROUPS)]
    return min((free for free in found if free is not None), default=None)


def _of_machine() -> int | None:
    kilobytes = _table(MEMINFO).get("MemAvailable:")
    return None if kilobytes is None else kilobytes * 1024


def _of_container(bound: Path, used: Path, stat: Path, cached: str) -> int | None:
    try:
        limit = bound.read_text().strip()
        taken = int(used.read_text())
    except (OSError, ValueError):
        return None
    if not limit.isdigit():  # "max": no bound
        return None
    return max(0, int(limit) - taken + _table(stat).get(cached, 0))


def _table(path: Path) -> dict[str, int]:
    """Lines of a name and a number."""
    try:
        lines = [line.split() for line in path.read_text().splitlines()]
    except (OSError, ValueError):
        return {}
    return {line[0]: int(line[1]) for line in lines if len(line) > 1 and line[1].isdigit()}
