"""Where a learner meets workers that it starts on this machine, and whether they need keys for it. Shared by the launchers.

The law: a socket file lies in a folder of its own that only this user can enter (0700), and goes with it.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

from learner.config.config import Config
from learner.members.endpoint import throwaway
from protocol.errors import UsageError
from protocol.keys.key_folder import Keyring, chosen_key_folder
from protocol.keys.keys import Token
from workers.host import core_flags

StartFlags = Callable[[str], tuple[list[str], Path | None]]
"""By a worker's name: the flags that its process is started with, and the file that its stderr goes to."""


def own_address(transport: str, stack: ExitStack) -> str:
    """An address that nobody else has; `stack` tidies up after it."""
    match transport:
        case "inproc":
            return f"inproc://millrace-{os.getpid()}-{time.monotonic_ns()}"
        case "tcp":
            return "tcp://127.0.0.1:*"
        case "ipc":
            folder = tempfile.mkdtemp(prefix="millrace-")  # 0700: the operating system decides who may connect
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            return f"ipc://{folder}/learner"
        case _:
            raise UsageError(f"transport expected ipc, tcp or inproc, got {transport!r}")


def own_keys(transport: str, keys: str, *, insecure: bool) -> tuple[Keyring | None, Token | None]:
    """Keys for this run alone, where loopback TCP is to have some: a key folder was named."""
    sealed = transport == "tcp" and chosen_key_folder(keys) is not None and not insecure
    return throwaway("local", datetime.now(UTC)) if sealed else (None, None)


def flags_of(config: Config, run: Path) -> StartFlags:
    """Those of a run's workers; their logs lie in the run folder."""
    logs = run / "workers"
    logs.mkdir(exist_ok=True)
    cores = cores_for(config)

    def flags(name: str) -> tuple[list[str], Path]:
        return ["--step-timeout-s", str(config.step_timeout_s), *core_flags(cores, name)], logs / f"{name}.log"

    return flags


def cores_for(config: Config) -> list[int]:
    """The cores that local workers keep to, in turn; none if they go where they are put. Raises `UsageError`.

    New weights wake all workers at once, while the learner still runs: left to itself, Linux then often puts two on one core
    and lets another one idle, for so short a time that it never moves them. Fewer workers than cores find a free one by
    themselves, and would meet those of another run on theirs.
    """
    if not hasattr(os, "sched_setaffinity"):
        if config.pin_workers:
            raise UsageError("pin_workers: this system does not let a process keep to one core")
        return []
    cores = sorted(os.sched_getaffinity(0))
    take_turns = config.max_lag == 0 and config.workers % len(cores) == 0
    return cores if config.pin_workers or (config.pin_workers is None and take_turns) else []
