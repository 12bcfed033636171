"""Which process trains the run in a folder now, and where this machine can ask its learner.

Rule: the lock file (`run_lock.py`) is only read, without its lock. If the clocks of two machines differ by much, the answer
is wrong, so no write depends on it.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

from millrace.learner.run_folder.lease import WIDTH, Owner, Unreachable, decoded
from millrace.learner.run_folder.owner_process import (
    can_look_up,
    is_copy,
    is_gone,
    is_in_this_network,
    is_on_this_machine,
)
from millrace.learner.run_folder.regular_files import read, reason
from millrace.learner.run_folder.run_lock import LOCK_FILE, PACE
from millrace.protocol.address import is_local
from millrace.protocol.errors import UsageError

WHY_UNREACHABLE = {
    Unreachable.INPROC: "with --transport inproc it listens in its own process only; run it with --transport ipc",
    Unreachable.KEYS_OF_THE_RUN: (
        "with --transport tcp and --keys, the keys of its local workers are not in any file; run it with --transport ipc"
    ),
}


class LearnerOfRun(NamedTuple):
    """Where this machine can ask the learner of a run."""

    address: str
    keys: Path | None
    """The learner's key folder, which may be on another machine; None if no key is needed."""
    is_here: bool
    """Whether the learner is on this machine and in this network. If so, `address` is its own address."""


def learner_of_run(folder: Path) -> LearnerOfRun:
    """Where the learner that now trains the run in this folder listens.

    Raises `UsageError`, with a one-line message, if no learner trains the run, or if the learner cannot be asked from this
    machine.
    """
    owner = living_owner(folder, time.time())
    if not owner.address:
        why = "it has not begun yet; try again" if owner.unreachable is None else WHY_UNREACHABLE[owner.unreachable]
        raise UsageError(f"run {folder}: {owner} trains it and cannot be asked: {why}")
    here = is_on_this_machine(owner) and (not owner.address.startswith("tcp://") or is_in_this_network(owner))
    if not here and is_local(owner.address):
        raise UsageError(f"run {folder}: {owner} trains it, and only that machine can reach it; ask there")
    return LearnerOfRun(owner.here if here else owner.address, Path(owner.keys) if owner.keys else None, here)


def living_owner(folder: Path, now: float) -> Owner:
    """The process that seems to train the run in this folder, for display. `now` is wall-clock time.

    A process on this machine is looked up by its process number, and doesn't train a copy of its folder. Any other process,
    such as one in a container, counts as alive if it rewrote the file in the last few seconds. Raises `UsageError`, with a
    one-line message, if no process seems to train the run.
    """
    path = folder / LOCK_FILE
    try:
        owner = decoded(read(path, WIDTH))
        age_s = now - path.lstat().st_mtime
    except FileNotFoundError:
        raise UsageError(f"run {folder}: {'no process trains it now' if folder.is_dir() else 'no such folder'}") from None
    except OSError as error:
        raise UsageError(f"run {folder}: {LOCK_FILE} cannot be read: {reason(error)}") from error
    if owner is None:
        raise UsageError(f"run {folder}: {LOCK_FILE} names no process; it is being written, or damaged: try again")
    if is_gone(owner) or (not can_look_up(owner) and age_s >= PACE.dead_after):
        raise UsageError(f"run {folder}: no process trains it now; {owner} did, and is gone")
    if is_copy(folder, owner):
        raise UsageError(f"run {folder}: no process trains it now; it is a copy of the folder in which {owner} trains")
    return owner
