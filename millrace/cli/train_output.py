"""Shows the progress of a run that a command trains, and finally prints how the run ended and what to do next.

Rule: output that can't be written is dropped, and the run continues.
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from millrace.flags.parse import typed_flags
from millrace.flags.program_name import typed_name
from millrace.learner.between_updates.stop_rules import BY_THE_POLICY_OF
from millrace.learner.config.local_workers import chosen_workers
from millrace.learner.config.presets import origin
from millrace.learner.run_folder.results import ALL_STEPS_DONE
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.standard_streams import unfailing
from millrace.protocol.errors import joined
from millrace.protocol.logs.notices import log_notice
from millrace.protocol.machine.cpu_cores import usable_cores
from millrace.terminal import progress_view

if TYPE_CHECKING:
    from millrace.learner.callbacks.callbacks import Watch
    from millrace.learner.config.config import Config
    from millrace.learner.run_folder.progress import Progress
    from millrace.learner.run_folder.results import Summary

log = logging.getLogger("millrace.learner")


class ShownRun:
    """Shows the progress of a run, and prints how it ended."""

    def __init__(self, argv: list[str], new: Config | None = None, command: str = "train") -> None:
        """`new`: the settings of a new run; where they come from is shown before the first report. None if a run is resumed.

        `command`: the millrace command that trains the run, and can resume it.
        """
        self._log_json = any(typed.name == "log_json" for typed in typed_flags(argv))
        self._new = new
        self._command = command

    @contextmanager
    def progress(self) -> Iterator[Watch]:
        """A context manager that yields a function. To show a `Progress`, call the function with it."""
        with unfailing("stdout"), progress_view(self._log_json) as watch:
            yield watch if self._new is None else _after_origin(self._new, self._command, watch)

    def end(self, run: Path) -> int:
        """Print how the run in this folder ended. Returns the exit code."""
        summary = RunFolder(run).summary()
        lines = [] if summary is None else result(summary)
        lines += [f"run folder: {run}"] if self._log_json else next_commands(run, summary, self._command)
        with unfailing("stdout"):
            print("\n".join(lines))
        return 0


def _after_origin(config: Config, command: str, watch: Callable[[Progress], None]) -> Callable[[Progress], None]:
    """Wrap `watch` so that its first call also logs where the settings come from and how many workers `train` chose."""
    workers = chosen_workers(config, usable_cores()) if command == "train" else ""
    lines = iter([joined(origin(config), workers)])

    def logged(progress: Progress) -> None:
        for line in lines:
            log_notice(log, line)
        watch(progress)

    return logged


def result(summary: Summary) -> list[str]:
    """Lines that say how a run ended and how its policies were evaluated."""
    lines = [f"{summary.stop_reason}: {summary.env_steps:,} env steps in {summary.wall_s:.1f} s"]
    if summary.evaluation is not None:
        ended_by_final = summary.ended_by is not None and BY_THE_POLICY_OF not in summary.stop_reason
        others = ", on other episodes than those that ended the run" if ended_by_final else ""
        lines.append(f"greedy {summary.evaluation}{others}")
    if (best := summary.best) is not None and best.env_steps != summary.env_steps:
        lines.append(f"best policy, after {best.env_steps:,} env steps: greedy {best.evaluation}")
    return lines


def next_commands(run: Path, summary: Summary | None, command: str) -> list[str]:
    """Shell commands that show the run, play its policy, and, if the run has taken all its steps, train as long again."""
    where = shlex.quote(str(run))
    evaluated = None if summary is None else summary.evaluation
    against = " --against ANOTHER_RUN" if evaluated is not None and evaluated.score_interval is not None else ""
    commands = [f"dashboard {where}", f"evaluate {where}{against}"]
    if summary is not None and summary.stop_reason == ALL_STEPS_DONE:
        commands.append(f"{command} --resume {where} --steps {float(f'{2 * summary.env_steps:.2g}'):.0f}")
    return ["next:", *(f"  {typed_name()} {line}" for line in commands)]
