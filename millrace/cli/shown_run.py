"""Train, show the progress meanwhile, and print how the run ended.

Rule: output that cannot be written is dropped; the run goes on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from learner.config.presets import origin
from learner.run_folder.run_folder import RunFolder
from learner.standard_streams import unfailing
from millrace.terminal import progress_view
from protocol.logs.notices import log_notice

if TYPE_CHECKING:
    from learner.callbacks.callbacks import Watch
    from learner.config.config import Config
    from learner.run_folder.progress import Progress

log = logging.getLogger("millrace.learner")


def show_run(argv: list[str], train: Callable[[Watch], Path], new: Config | None = None) -> int:
    """Train. `new`: the settings of a new run, whose origin is shown before its first progress. Returns the exit code."""
    with unfailing("stdout"):
        with progress_view("--log-json" in argv) as watch:
            run = train(watch if new is None else _after_origin(new, watch))
        return _print_result(run)


def _after_origin(config: Config, watch: Callable[[Progress], None]) -> Callable[[Progress], None]:
    """The same function, which at first logs where the settings come from."""
    lines = iter([origin(config)])

    def logged(progress: Progress) -> None:
        for line in lines:
            log_notice(log, line)
        watch(progress)

    return logged


def _print_result(run: Path) -> int:
    """Print how a run ended, and its folder."""
    summary = RunFolder(run).summary()
    if summary is not None:
        print(f"{summary.stop_reason}: {summary.env_steps:,} env steps in {summary.wall_s:.1f} s")
        if summary.evaluation is not None:
            print(f"greedy {summary.evaluation}")
        if (best := summary.best) is not None and best.env_steps != summary.env_steps:
            print(f"best policy, after {best.env_steps:,} env steps: greedy {best.evaluation}")
    print(f"run folder: {run}")
    return 0
