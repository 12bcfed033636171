"""Available memory of this machine or of its container, read from the files of the Linux kernel."""

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
"""cgroup version 2, then 1: the limit, the usage, and the file and field with the reclaimable file cache in it"""
GIB = 2**30


def available_bytes() -> int | None:
    """Bytes that can be allocated without swapping, or None where the system does not say."""
    found = [_machine_bytes(), *(_container_bytes(*paths) for paths in CGROUPS)]
    return min((free for free in found if free is not None), default=None)


def _machine_bytes() -> int | None:
    kilobytes = _table(MEMINFO).get("MemAvailable:")
    return None if kilobytes is None else kilobytes * 1024


def _container_bytes(limit_file: Path, usage_file: Path, stat_file: Path, cache_field: str) -> int | None:
    try:
        limit = limit_file.read_text().strip()
        taken = int(usage_file.read_text())
    except (OSError, ValueError):
        return None
    if not limit.isdigit():  # "max": no limit
        return None
    return max(0, int(limit) - taken + _table(stat_file).get(cache_field, 0))


def _table(path: Path) -> dict[str, int]:
    """A file whose lines are a name and a number."""
    try:
        lines = [line.split() for line in path.read_text().splitlines()]
    except (OSError, ValueError):
        return {}
    return {line[0]: int(line[1]) for line in lines if len(line) > 1 and line[1].isdigit()}
