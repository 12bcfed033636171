"""The process that owns a lock, as this process sees it: whether it is on this machine, and whether it has ended.

Rule: a process number is valid only in one container of one machine, so the number of a process elsewhere is never looked
up.
"""

from __future__ import annotations

import os
import secrets
import socket
from pathlib import Path

from millrace.learner.run_folder.lease import Owner

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
NETWORK = Path("/proc/self/ns/net")
NUMBERS = Path("/proc/self/ns/pid")


def new_owner(folder: Path) -> Owner:
    """The owner of a new lock in this run folder, which is this process."""
    return Owner(
        host=socket.gethostname(),
        pid=os.getpid(),
        boot_id=_boot(),
        token=secrets.token_hex(8),
        network_namespace=_namespace(NETWORK),
        pid_namespace=_namespace(NUMBERS),
        folder=inode(folder),
    )


def is_on_this_machine(owner: Owner) -> bool:
    """Whether the owner's process is, or was, on this machine, perhaps in a container."""
    return owner.boot_id == _boot()


def is_in_this_network(owner: Owner) -> bool:
    """Whether the owner's process is in the network of this process, if both are on one machine."""
    return owner.network_namespace == _namespace(NETWORK)


def can_look_up(owner: Owner) -> bool:
    """Whether this process can look up the owner's process number, because both are in one container of one machine."""
    return is_on_this_machine(owner) and owner.pid_namespace == _namespace(NUMBERS)


def is_gone(owner: Owner) -> bool:
    """Whether the owner's process has ended. False if that cannot be known."""
    return can_look_up(owner) and not _is_alive(owner.pid)


def is_copy(folder: Path, owner: Owner) -> bool:
    """Whether this folder is a copy of the folder that the owner trains. False if that cannot be known.

    Device numbers aren't compared, because one file system may have several. Other machines aren't compared, because some
    network file systems have different inode numbers on each machine.
    """
    return can_look_up(owner) and "" != owner.folder != inode(folder)


def inode(folder: Path) -> str:
    """The inode number of this folder; empty if it cannot be read."""
    try:
        return str(folder.stat().st_ino)
    except OSError:
        return ""


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # the process belongs to another user
        return True
    return True


def _boot() -> str:
    """The boot id of the running kernel; the host's name if that cannot be read."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return f"host {socket.gethostname()}"


def _namespace(kind: Path) -> str:
    """The namespace of this kind to which this process belongs; empty if it is not known."""
    try:
        return os.readlink(kind)
    except OSError:
        return ""
