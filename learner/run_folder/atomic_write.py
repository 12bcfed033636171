"""Writes files atomically, and retries writes that have failed.

Rule: a file is written next to its target under a name that ends with `.tmp`, flushed to the disk, and then renamed to the
target; the folder is flushed, too. If anything fails, the target stays unchanged and the temporary file is removed. Files
that nobody needs after a power failure are the only ones that aren't flushed. If a write fails during training, for example
because the disk is full, a warning is logged; the run fails only if the write still fails at its end.
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from millrace.learner.run_folder.regular_files import open_regular, reason
from millrace.protocol.errors import RunError

log = logging.getLogger("millrace.learner")

TEMPORARY = ".tmp"
SAY_AGAIN_S = 60.0  # seconds between two warnings with the same reason
TRY_FOR_S = 10.0  # seconds for which failed writes are retried at the end of a run, in case somebody frees space
TRY_EVERY_S = 0.5

Write = Callable[[], object]
"""Writes the current state of something. Raises `RunError` if that fails."""


def write_atomically(target: Path, write: Callable[[BinaryIO], object], *, flush: bool = True) -> None:
    """Let `write` fill a new file, and replace the target with it. Raises what `write` or the file system raises.

    `write` may read what it has written. If `flush`, waits until the file is on the disk.
    """
    temporary = target.with_name(target.name + TEMPORARY)
    temporary.unlink(missing_ok=True)  # it may be left from a process that was killed, or be a link
    try:
        with os.fdopen(open_regular(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL), "w+b") as file:
            write(file)
            if flush:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if flush:
        _flush_folder(target.parent)


def write_file(target: Path, write: Callable[[BinaryIO], object]) -> None:
    """Like `write_atomically`, but raises `RunError`, with a one-line message, if the file system raises."""
    try:
        write_atomically(target, write)
    except (OSError, ValueError) as error:  # ValueError is raised for an invalid file name
        raise RunError(f"{target} not written: {reason(error)}") from error


def _flush_folder(folder: Path) -> None:
    """Flush a folder to the disk, so that new names in it survive a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class Writes:
    """Calls the functions that write a run's files, and remembers those that have failed, by name."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep) -> None:
        self._clock = clock
        self._sleep = sleep
        self._refused: dict[str, tuple[Write, RunError]] = {}
        self._said: dict[str, tuple[str, float]] = {}
        self.at_most: Callable[[float], float] = lambda seconds: seconds
        """Limits the seconds for which `confirm` tries, because there is less time once a signal has ended the run."""

    def write(self, name: str, write: Write) -> None:
        """Call `write`. If it fails, log a warning; `confirm` will call it again."""
        if self._is_written(name, write):
            return
        line = str(self._refused[name][1])
        now = self._clock()
        said, since_s = self._said.get(name, ("", -math.inf))
        if line != said or now - since_s >= SAY_AGAIN_S:
            self._said[name] = line, now
            log.warning("%s", line)

    def confirm(self) -> None:
        """Retry failed writes for a while, until they succeed or Ctrl-C is pressed. Raises `RunError` if some still fail."""
        if not self._refused:
            return
        for_s = self.at_most(TRY_FOR_S)
        end_s = self._clock() + for_s
        log.warning("the run ends, and not everything is saved: trying again for %.0f s", for_s)
        with suppress(KeyboardInterrupt):
            while True:
                for name, (write, _) in [*self._refused.items()]:
                    self._is_written(name, write)
                if not self._refused or self._clock() >= end_s:
                    break
                self._sleep(TRY_EVERY_S)
        if self._refused:
            raise RunError("; ".join(dict.fromkeys(str(error) for _, error in self._refused.values())))

    def _is_written(self, name: str, write: Write) -> bool:
        try:
            write()
        except RunError as error:
            self._refused[name] = write, error
            return False
        self._refused.pop(name, None)
        return True
