"""The line that sums up a run: its state, its progress and its return. Only a few files in the run folder are read for it.

Rule: a folder that can't be read also gets a line, which says why. Because nothing records that a run died, a run counts as
dead if no process trains it and it has no results.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from millrace.learner.config.presets import environment_name
from millrace.learner.run_folder.last_line import resume_command
from millrace.learner.run_folder.lease import Owner
from millrace.learner.run_folder.living_owner import living_owner
from millrace.learner.run_folder.progress_file import last_progress
from millrace.learner.run_folder.regular_files import reason
from millrace.learner.run_folder.results import ALL_STEPS_DONE, Summary, read_summary
from millrace.learner.run_folder.run_format import RUN_FILE, check_format, is_run_folder, read_config
from millrace.learner.run_folder.sentences import (
    duration,
    ending,
    last_sign,
    per_second,
    percent,
    return_in_words,
    steps_in_words,
)
from millrace.protocol.bounds import INVALID, LARGEST, MAX_NAME, one_line
from millrace.protocol.errors import UsageError
from millrace.protocol.progress import RunProgress

RunCondition = Literal["training", "finished", "interrupted", "dead", "unreadable"]
MOST_RUNS = 1_000  # the largest number of runs that are listed
MOST_REASON = 40  # limit on the characters of a reason
STARTED = re.compile(r"-(\d{8}-\d{6})(?:-\d{1,9})?")


class RunLine(NamedTuple):
    """The main facts about one run."""

    path: Path
    state: RunCondition
    owner: Owner | None = None
    """the process that trains it, if there is one"""
    env: str = ""
    algo: str = ""
    seed: int = 0
    started: str = ""
    progress: RunProgress = RunProgress()
    """how far the run has got"""
    summary: Summary | None = None
    problem: str = ""
    """why the run cannot be read; empty if it can"""

    @property
    def name(self) -> str:
        """The name of the run's folder, safe to show."""
        return one_line(self.path.resolve().name, MAX_NAME)

    @property
    def begins(self) -> bool:
        """Whether the run trains but its progress isn't known yet, because there are no numbers before the first update."""
        return self.state == "training" and not (self.progress.updates or self.progress.env_steps_made)

    @property
    def has_numbers(self) -> bool:
        """Whether the run's progress is known. A power failure may have destroyed the file that records it."""
        return not self.begins and (self.summary is not None or self.progress.at_s > 0.0)

    @property
    def done(self) -> str:
        """How much of the run is done, or why it ended early."""
        if self.begins:
            return "before its first update"
        if not self.has_numbers:
            return "–"
        if self.summary is not None and (reason := self.summary.stop_reason) != self.state:
            return "100%" if reason == ALL_STEPS_DONE else one_line(reason, MOST_REASON)
        sign = last_sign(self.progress) if self.state == "dead" else ""
        return f"{percent(self.progress)}, {sign}" if sign else percent(self.progress)

    @property
    def left_s(self) -> float | None:
        """Seconds of training that are left at the speed so far; None if this is not known."""
        return self.progress.left_s if self.state == "training" else None


def find_runs(folders: Iterable[Path]) -> list[Path]:
    """The run folders among these folders, and directly inside them, the newest first.

    Raises `UsageError` if one of `folders` can't be read as a folder.
    """
    runs: dict[Path, None] = {}
    for folder in folders:
        try:
            inside = [] if is_run_folder(folder) else sorted(folder.iterdir())
        except OSError as error:
            raise UsageError(f"runs {folder}: {reason(error)}; expected a run folder, or a folder of runs") from error
        runs |= dict.fromkeys([path for path in inside if is_run_folder(path)] or [folder] * is_run_folder(folder))
    return sorted(runs, key=lambda path: (_started(path), path.name), reverse=True)[:MOST_RUNS]


def read_line(path: Path, now: float) -> RunLine:
    """Read the main facts about the run in a folder. `now` is wall-clock time."""
    try:
        check_format(path)
        config = read_config(path)
        name = environment_name(config["env"], config.get("env_kwargs", {}), config["algo"])
    except UsageError as error:
        return RunLine(path, "unreadable", problem=str(error))
    summary = None
    owner = None
    with suppress(UsageError):
        owner = living_owner(path, now)
    if owner is None:
        try:
            summary = read_summary(path)
        except (OSError, *INVALID):
            summary = None
    steps = config.get("steps")
    return RunLine(
        path=path,
        state="training" if owner else "dead" if summary is None else "interrupted" if summary.cut_short else "finished",
        owner=owner,
        env=one_line(name, MAX_NAME),
        algo=one_line(config["algo"], MAX_NAME),
        seed=config["seed"],
        started=_started(path),
        progress=last_progress(path, summary, steps if isinstance(steps, int) and 0 <= steps <= LARGEST else 0),
        summary=summary,
    )


def headline(line: RunLine) -> str:
    """A sentence that says how far the run has got, how it ended, or that it died, and how to continue it."""
    match line.state:
        case "training" if line.begins:
            return f"Training: {line.done}."
        case "training":
            left = "" if line.left_s is None else f", about {duration(line.left_s)} left"
            return f"Training: {line.done} done, {per_second(line.progress.steps_per_s)} env steps per second{left}."
        case "unreadable":
            return f"It cannot be read: {line.problem}."
        case "dead":
            sign = last_sign(line.progress)
            known = f"no process trains it, and it has no results{f'; {sign}' if sign else ''}"
            return f"Dead: {known}. It was killed, or its machine went down; {_how_to_continue(line.path)}"
        case _:
            assert line.summary is not None
            said = ending(one_line(line.summary.stop_reason), cut_short=line.summary.cut_short)
            return f"{said}; {_how_to_continue(line.path)}" if line.summary.cut_short else f"{said}."


def _how_to_continue(run: Path) -> str:
    return f"continue it with: {one_line(resume_command(run))}"


def in_sentences(line: RunLine) -> str:
    """The last state of a run that no process trains, as lines for a terminal."""
    progress = line.progress
    done = f"{steps_in_words(progress)} env steps in {duration(progress.wall_s)}"
    figures = f": {done}, return {return_in_words(progress.return_mean)}" if line.has_numbers else ""
    lines = [headline(line), f"{line.env}, {algorithm_label(line.algo)}, seed {line.seed}{figures}"]
    if line.summary is not None and line.summary.evaluation is not None:
        lines.append(one_line(f"greedy {line.summary.evaluation}"))
    return "\n".join(lines)


def algorithm_label(algo: str) -> str:
    """The name of an algorithm in a legend, such as PPO, or a user-defined algorithm's class name."""
    _, own, name = algo.rpartition(":")
    return name if own else algo.upper()


def _started(path: Path) -> str:
    """When the run began: the time in its folder's name or, if there is none, the modification time of its run.json."""
    stamp = STARTED.search(path.name)
    try:
        began = time.strptime(stamp[1], "%Y%m%d-%H%M%S") if stamp else time.localtime((path / RUN_FILE).lstat().st_mtime)
    except (OSError, ValueError, OverflowError):
        return ""
    return time.strftime("%Y-%m-%d %H:%M", began)
