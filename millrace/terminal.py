"""How a run looks while it goes on: one live block on a terminal, a line now and then anywhere else.

The law: it never slows the run (at most five redraws a second), the last state is always shown, and a reader that went away
(`| head`) does not end the run. What the log says is shown above the block.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from learner.run_folder.json_log import JsonLines, progress_line
from learner.run_folder.progress import Progress

REDRAW_EVERY_S = 0.2
LINE_EVERY_S = 5.0


class Screen(Protocol):
    """Where progress is shown."""

    def show(self, progress: Progress) -> None:
        """Show this state now."""
        ...

    def say(self, line: str) -> None:
        """Show a line that stays."""
        ...

    def close(self) -> None:
        """Leave the terminal as it should be."""
        ...


@contextmanager
def watching(log_json: bool = False, clock: Callable[[], float] = time.monotonic) -> Iterator[Callable[[Progress], None]]:
    """A function to call with each progress; what the log of millrace says meanwhile is shown too."""
    block = sys.stdout.isatty() and not log_json
    screen: Screen = Block(Console()) if block else Events() if log_json else Lines()
    pace = Pace(screen, REDRAW_EVERY_S if block else LINE_EVERY_S, clock)
    handler = _events_handler() if log_json else _Said(screen)
    logger = logging.getLogger("millrace")
    level = logger.level
    logger.addHandler(handler)
    if log_json:
        logger.setLevel(logging.INFO)
    try:
        yield pace
    finally:
        pace.close()
        screen.close()
        logger.removeHandler(handler)
        logger.setLevel(level)


class Pace:
    """Passes on the first progress, then at most one in `every_s`, and the last one. A new note is said at once."""

    def __init__(self, screen: Screen, every_s: float, clock: Callable[[], float]) -> None:
        self._screen, self._every_s, self._clock = screen, every_s, clock
        self._shown_s = -every_s
        self._waiting: Progress | None = None
        self._note = ""

    def __call__(self, progress: Progress) -> None:
        """A new state of the run."""
        if progress.note and progress.note != self._note:
            self._screen.say(progress.note)
        self._note = progress.note
        self._waiting = progress
        if self._clock() - self._shown_s >= self._every_s:
            self._show()

    def close(self) -> None:
        """Show what has not been shown yet."""
        self._show()

    def _show(self) -> None:
        if self._waiting is not None:
            self._screen.show(self._waiting)
            self._waiting, self._shown_s = None, self._clock()


class Lines:
    """Plain lines: for logs, pipes and batch systems."""

    def show(self, progress: Progress) -> None:
        """One line."""
        parts = [f"{progress.env_steps:,} of {progress.total_steps:,} env steps", *figures(progress).values()]
        self.say(" | ".join(parts))

    def say(self, line: str) -> None:
        """The line."""
        try:
            print(line, flush=True)
        except BrokenPipeError:  # nobody reads any more; the run goes on, and Python's exit must not stumble either
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    def close(self) -> None:
        """Nothing to do."""


class Events:
    """JSON lines on stderr, for machines."""

    def show(self, progress: Progress) -> None:
        """One line."""
        sys.stderr.write(f"{progress_line(progress, time.time())}\n")

    def say(self, line: str) -> None:
        """Nothing: notes stand in the progress, and what the log says is a line of its own."""

    def close(self) -> None:
        """Nothing to do."""


def _events_handler() -> logging.Handler:
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines())
    return handler


class Block:
    """The live block."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False)
        self._live.start()

    def show(self, progress: Progress) -> None:
        """Redraw the block."""
        self._live.update(block(progress), refresh=True)

    def say(self, line: str) -> None:
        """The line, above the block."""
        self._console.print(line, markup=False, highlight=False)

    def close(self) -> None:
        """Leave the block as it is and give the cursor back."""
        self._live.stop()


def figures(progress: Progress) -> dict[str, str]:
    """What matters most of a progress, in words."""
    expected = progress.workers_expected
    score = "none yet" if progress.return_mean is None else f"{progress.return_mean:,.1f}"
    return {
        "speed": f"{progress.steps_per_s:,.0f} steps/s",
        "return": f"return {score}",
        "lag": f"lag {progress.lag_mean:.1f} (max {progress.lag_max})",
        "workers": f"workers {progress.workers_alive}" + (f" of {expected}" if expected else ""),
        "update": f"update {progress.updates:,}",
    }


def block(progress: Progress) -> RenderableType:
    """The block: a bar, the figures, where time goes, what became of tickets and transitions, the run folder."""
    done = min(1.0, progress.env_steps / progress.total_steps) if progress.total_steps else 0.0
    bar = Table.grid(padding=(0, 1))
    bar.add_row(
        ProgressBar(total=1.0, completed=done, width=34, complete_style="cyan", finished_style="green"),
        Text(f"{done:4.0%}", style="bold"),
        Text(f"{progress.env_steps:,} of {progress.total_steps:,} env steps"),
        Text(_left(progress, done), style="dim"),
    )
    head = Text("   ").join(_emphasised(name, text, progress) for name, text in figures(progress).items())
    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="dim", no_wrap=True)
    rows.add_column(overflow="fold")
    for name, text in details(progress).items():
        rows.add_row(name, text)
    return Group(bar, head, rows)


def details(progress: Progress) -> dict[str, str]:
    """The smaller print of a progress: stages as shares of their owner's time, counts that are not zero, the folder."""
    rows = {}
    for owner in ("learner", "worker"):
        seconds = {name.removeprefix(f"{owner}_"): s for name, s in progress.stages.items() if name.startswith(owner)}
        if total := sum(seconds.values()):
            rows[f"{owner} time"] = " · ".join(f"{name} {s / total:.0%}" for name, s in seconds.items())
    for kind in ("tickets", "transitions", "messages"):
        counts = {name: count for name, count in progress.ledger.items() if _kind(name) == kind and count}
        if counts:
            rows[kind] = " · ".join(f"{name.removeprefix(f'{kind}_')} {count:,}" for name, count in counts.items())
    return rows | {"run": progress.run}


def _kind(name: str) -> str:
    """What a count of the ledger counts; plain names count tickets."""
    first, _, rest = name.partition("_")
    return first if rest and first in ("transitions", "messages") else "tickets"


def _left(progress: Progress, done: float) -> str:
    steps = progress.total_steps - progress.env_steps
    if done >= 1 or not progress.steps_per_s:
        return f"{_clock_time(progress.wall_s)} in all"
    return f"{_clock_time(progress.wall_s)}, {_clock_time(steps / progress.steps_per_s)} left"


def _clock_time(seconds: float) -> str:
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02}:{s:02}" if hours else f"{m}:{s:02}"


def _emphasised(name: str, text: str, progress: Progress) -> Text:
    running = progress.env_steps < progress.total_steps
    missing = name == "workers" and running and progress.workers_alive < progress.workers_expected
    return Text(text, style={"return": "bold green"}.get(name, "bold yellow" if missing else "bold"))


class _Said(logging.Handler):
    """What the log says, on the screen."""

    def __init__(self, screen: Screen) -> None:
        super().__init__(logging.WARNING)
        self._screen = screen

    def emit(self, record: logging.LogRecord) -> None:
        """One record."""
        self._screen.say(f"{record.levelname.lower()}: {record.getMessage()}")
