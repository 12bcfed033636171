"""The available memory of this machine, or of this job or container if it has less. Read from Linux kernel files."""

from __future__ import annotations

from pathlib import Path

from millrace.protocol.machine.control_groups import free_bytes, table

GIB = 2**30


def available_bytes(system: Path = Path("/")) -> int | None:
    """The number of bytes that can be allocated without swapping, or None if the system does not report it."""
    kilobytes = table(system / "proc/meminfo").get("MemAvailable:")
    machine = None if kilobytes is None else kilobytes * 1024
    return min((free for free in (machine, free_bytes(system)) if free is not None), default=None)
