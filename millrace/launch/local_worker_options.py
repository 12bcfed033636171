"""Options of local workers: their keys, flags and cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from millrace.learner.config.config import Config
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.members.who_may_connect import generate_run_keys
from millrace.learner.run_folder.regular_files import open_regular, reason, subfolder
from millrace.protocol.errors import UsageError
from millrace.protocol.keys.key_folder import Keyring, chosen_key_folder
from millrace.protocol.keys.keys import Token
from millrace.workers.supervise.supervisor import Supervisor, core_flags

LEAVE_AT_ONCE_S = 0.5  # after a start that failed: a worker in the constructor of its environment hears nothing

FlagsOfWorker = Callable[[str], tuple[list[str], Path | None]]
"""Takes a worker's name. Returns the flags of its process, and the file for its stderr (None: this process's stderr)."""


@contextmanager
def stopped_on_error(supervisor: Supervisor) -> Iterator[None]:
    """Stop the workers soon if the body raises: there is no run yet, and none of their work could be lost."""
    try:
        yield
    except BaseException:
        supervisor.stop(LEAVE_AT_ONCE_S)
        raise


def temporary_keys(transport: str, keys: str, *, insecure: bool) -> tuple[Keyring | None, Token | None]:
    """Keys for this run only, if it uses TCP and a key folder was named; else None."""
    encrypted = transport == "tcp" and chosen_key_folder(keys) is not None and not insecure
    return generate_run_keys("local", datetime.now(UTC)) if encrypted else (None, None)


def no_flags(name: str) -> tuple[list[str], Path | None]:
    """Those of a worker without options of its own, which writes to this process's stderr: a `FlagsOfWorker`."""
    return [], None


def worker_flags(config: Config, run: Path) -> FlagsOfWorker:
    """The flags of a run's workers. Their logs are in the run folder. Raises `UsageError` if they cannot be there."""
    try:
        logs = subfolder(run, "workers")
        for log in logs.glob("*.log"):
            os.close(open_regular(log))
    except OSError as error:
        raise UsageError(f"{error.filename}: {reason(error)}; the workers' logs go there: remove it") from error
    cores = [] if config.eval_workers else worker_cores(config)

    def flags(name: str) -> tuple[list[str], Path]:
        return core_flags(cores, name), logs / f"{name}.log"

    return flags


def worker_cores(config: RolloutConfig) -> list[int]:
    """The cores that local workers are pinned to, in turn; empty if they are not pinned.

    New weights wake all workers at once, while the learner still runs. Linux then often puts two workers on one core and
    leaves another core idle, for too short a time to move them. If there are fewer workers than cores, they are not
    pinned: Linux finds a free core for each, and pinned workers could share a core with the workers of another run. Nor are
    they with a lag, where it gains nothing.
    """
    if not hasattr(os, "sched_setaffinity"):
        return []
    cores = sorted(os.sched_getaffinity(0))
    return cores if config.max_lag == 0 and config.workers % len(cores) == 0 else []
