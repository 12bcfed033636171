"""progress.json: the progress of a run, written once a second while it trains. It shows when a killed run was last alive.

Rule: nothing depends on this file. It is replaced atomically, but not flushed to the disk, because that would slow the
training loop; a power failure may destroy it. Failed writes are not retried. Once the run has a summary, the summary is
used instead.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec
from msgspec.structs import replace

from millrace.learner.run_folder.atomic_write import write_atomically
from millrace.learner.run_folder.checkpoint import newest_env_steps
from millrace.learner.run_folder.regular_files import read
from millrace.learner.run_folder.results import Summary
from millrace.protocol.bounds import INVALID, LARGEST
from millrace.protocol.progress import RunProgress

PROGRESS_FILE = "progress.json"
EVERY_S = 1.0
LONGEST_SILENCE_S = 10.0  # after this time, the file is written even if nothing has changed, as a sign of life


class ProgressFile:
    """The progress.json of a run that this process trains."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / PROGRESS_FILE
        self._written = RunProgress()
        self._looked_s = 0.0

    def write(self, progress: Callable[[], RunProgress], now: float) -> None:
        """Write the progress if a second has passed and something has changed, or if the last write was long ago.

        `now` is in seconds since 1970.
        """
        if 0.0 <= now - self._looked_s < EVERY_S:
            return
        newest = replace(progress(), at_s=now)
        self._looked_s = now
        is_new = replace(newest, at_s=self._written.at_s) != self._written
        if not is_new and now - self._written.at_s < LONGEST_SILENCE_S:
            return
        with suppress(OSError, ValueError):  # ValueError is raised for an environment's text that is not UTF-8
            content = msgspec.json.encode(newest)
            write_atomically(self._path, lambda file: file.write(content), flush=False)
            self._written = newest


def last_progress(run: Path, summary: Summary | None, total_steps: int = 0) -> RunProgress:
    """The last known progress of a run, from its `summary` if there is one, otherwise from its progress.json.

    `total_steps`, from the run's settings, is all that is known if neither can be read.
    """
    if summary is not None:
        return of_summary(summary, total_steps)
    try:
        return msgspec.json.decode(read(run / PROGRESS_FILE), type=RunProgress)
    except (OSError, *INVALID):
        return RunProgress(total_steps=total_steps)


def progress_before(resumed: Path | None, total_steps: int) -> RunProgress:
    """The progress of a run before it begins. A resumed run begins at its newest checkpoint."""
    env_steps = 0 if resumed is None else min(newest_env_steps(resumed), LARGEST)
    return RunProgress(env_steps=env_steps, total_steps=total_steps)


def of_summary(summary: Summary, total_steps: int) -> RunProgress:
    """The progress of a run when it ended."""
    return RunProgress(
        env_steps=summary.env_steps,
        total_steps=total_steps,
        updates=summary.updates,
        wall_s=summary.wall_s,
        steps_per_s=summary.env_steps_per_s,
        return_mean=summary.return_mean_100,
        ledger=summary.ledger,
        stages=summary.stages,
        stop_reason=summary.stop_reason,
        cut_short=summary.cut_short,
    )
