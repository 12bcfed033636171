"""How much memory and CPU time this process may use under its control groups: those of a job (Slurm, systemd) or container.

Rule: a group is also bound by the limits of every group above it, so the lowest limit counts. The kernel has two versions
of control groups, and may use both at once: version 2 has one tree of groups, version 1 has one for each controller.

Pure: the functions read everything below a folder that stands for `/`, so a test can pass another folder.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

ALL = ""  # stands for all controllers: in version 2 they share one tree, and aren't named


class _Tree(NamedTuple):
    """A tree of groups, as it is mounted."""

    controllers: Sequence[str]
    root: PurePosixPath
    """the group whose folder is the mount point; a container without a cgroup namespace sees only its own part of the tree
    """
    mount_point: Path


class _MemoryFiles(NamedTuple):
    limits: Sequence[str]
    usage: str
    cache: str
    """the field of memory.stat that counts the file cache which the kernel reclaims first"""


MEMORY_FILES = (
    _MemoryFiles(("memory.max", "memory.high"), "memory.current", "inactive_file"),  # version 2
    _MemoryFiles(("memory.limit_in_bytes",), "memory.usage_in_bytes", "total_inactive_file"),  # version 1
)


def free_bytes(system: Path) -> int | None:
    """Bytes that this process can still allocate within the limits of its groups; None if they have no limit."""
    found = [_free_bytes(group, files) for group in _groups(system, "memory") for files in MEMORY_FILES]
    return min((free for free in found if free is not None), default=None)


def cpu_quota(system: Path) -> float:
    """CPU time that the groups of this process may use, in cores; infinite if they have no quota."""
    return min((_cpu_quota(group) for group in _groups(system, "cpu")), default=math.inf)


def table(path: Path) -> dict[str, int]:
    """Parse a file in which each line has a name and a number; empty if it cannot be read."""
    lines = [line.split() for line in _text(path).splitlines()]
    return {line[0]: int(line[1]) for line in lines if len(line) > 1 and line[1].isdecimal()}


# -------------------------------------------------------------------------------------------- one group


def _free_bytes(group: Path, files: _MemoryFiles) -> int | None:
    found = [_number(_text(group / name)) for name in files.limits]
    limits = [limit for limit in found if limit is not None]
    taken = _number(_text(group / files.usage))
    if not limits or taken is None:
        return None
    return max(0, min(limits) - taken + table(group / "memory.stat").get(files.cache, 0))


def _cpu_quota(group: Path) -> float:
    """The group's CPU quota in cores; infinite if it has none, which the kernel writes as "max" (version 2) or -1 (1)."""
    of_version_2 = _text(group / "cpu.max").split()
    of_version_1 = [_text(group / "cpu.cfs_quota_us"), _text(group / "cpu.cfs_period_us")]
    match [_number(text) for text in of_version_2 or of_version_1]:
        case [int(quota_us), int(period_us)] if period_us:
            return quota_us / period_us
    return math.inf


def _number(text: str) -> int | None:
    """Parse a whole number; None for anything else, such as the text of a missing file, or a word for "no limit"."""
    return int(text) if text.strip().isdecimal() else None


def _text(path: Path) -> str:
    """The content of a file; empty if it cannot be read."""
    try:
        return path.read_text("utf-8", "surrogateescape")
    except OSError:
        return ""


# -------------------------------------------------------------------------------------------- which groups


def _groups(system: Path, controller: str) -> Iterator[Path]:
    """The folders of all groups that can limit what this controller controls: in each tree, this process's group and those
    above it.
    """
    paths = _paths(system)
    for tree in _trees(system):
        for name in {controller, ALL} & set(tree.controllers) & set(paths):
            below = _below(paths[name], tree.root)
            yield from (tree.mount_point / part for part in (below, *below.parents))


def _below(path: PurePosixPath, root: PurePosixPath) -> PurePosixPath:
    """The path of a group, as seen from the mount point; the mount point itself if the group is not below it."""
    if path.is_relative_to(root) and ".." not in path.parts:
        return path.relative_to(root)
    return PurePosixPath()


def _paths(system: Path) -> dict[str, PurePosixPath]:
    """For each controller, the path of this process's group in that controller's tree."""
    paths: dict[str, PurePosixPath] = {}
    for line in _text(system / "proc/self/cgroup").splitlines():
        match line.split(":", 2):  # for example 4:cpu,cpuacct:/job_7, or, in version 2, 0::/job_7
            case [_, controllers, path]:
                paths |= dict.fromkeys(controllers.split(","), PurePosixPath(path))
    return paths


def _trees(system: Path) -> Iterator[_Tree]:
    for line in _text(system / "proc/self/mountinfo").splitlines():
        # For example: 31 23 0:28 ROOT MOUNT_POINT rw,relatime shared:9 - cgroup2 cgroup2 rw
        # In version 1, the last field names the controllers.
        match [mount.split(" ") for mount in line.split(" - ", 1)]:
            case [[_, _, _, root, mount_point, *_], [("cgroup" | "cgroup2") as kind, _, options, *_]]:
                controllers = [ALL] if kind == "cgroup2" else options.split(",")
                yield _Tree(controllers, PurePosixPath(_unescaped(root)), system / _unescaped(mount_point).lstrip("/"))


def _unescaped(path: str) -> str:
    r"""Decode a path in mountinfo, where a space is written as \040."""
    return re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), path)
