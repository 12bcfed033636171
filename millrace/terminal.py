"""Shows the progress of a run: as a live block on a terminal, as one display in a notebook, as lines elsewhere, or as JSON.

Rule: it never slows the run (at most five redraws a second), and the last progress is always shown. Warnings of the log are
shown above the block. No text is read as markup or controls the terminal. `learner.standard_streams` sees to it that a
stream which is full or closed does not end the run.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from html import escape
from typing import Any, Protocol, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from learner.run_folder.json_log import JsonLines, progress_line
from learner.run_folder.progress import Progress
from protocol.bounds import escaped
from protocol.logs.notices import is_notice

REDRAW_EVERY_S = 0.2
NOTEBOOK_EVERY_S = 0.5
LINE_EVERY_S = 5.0


class ProgressView(Protocol):
    """A way to show progress."""

    def show(self, progress: Progress) -> None:
        """Show this progress now."""
        ...

    def print_line(self, line: str) -> None:
        """Print a line that is not redrawn."""
        ...

    def close(self) -> None:
        """Restore the terminal."""
        ...


@contextmanager
def progress_view(
    log_json: bool = False, clock: Callable[[], float] = time.monotonic, *, may_fail: bool = True
) -> Iterator[Callable[[Progress], None]]:
    """A context manager that returns a function to call with each progress. Until it ends, millrace's log is shown too.

    `may_fail`: raise what showing raises. Otherwise it is dropped.
    """
    view, every_s = _view(log_json)
    if not may_fail:
        view = DroppingView(view)
    limited = RateLimitedView(view, every_s, clock)
    handler = _json_log_handler() if log_json else _WarningHandler(view)
    logger = logging.getLogger("millrace")
    level = logger.level
    logger.addHandler(handler)
    if log_json:
        logger.setLevel(logging.INFO)
    try:
        yield limited
    finally:
        limited.close()
        view.close()
        logger.removeHandler(handler)
        logger.setLevel(level)


@contextmanager
def shown_progress(
    watch: Callable[[Progress], object] | None, *, show: bool
) -> Iterator[Callable[[Progress], object] | None]:
    """Gives the function to call with each progress of a run that a user's program trains, if any. It calls `watch`, too.

    `show`: show the progress. An output that is closed or full does not end the run.
    """
    if not show:
        yield watch
        return
    with progress_view(may_fail=False) as view:

        def both(progress: Progress) -> object:
            view(progress)
            return None if watch is None else watch(progress)

        yield both


@contextmanager
def count_line(
    doing: str, clock: Callable[[], float] = time.monotonic, *, show: bool = True
) -> Iterator[Callable[[str], None]]:
    """Gives a function that shows a text, after `doing`: in place on a terminal or in a notebook, else a line now and then.

    Outside a notebook it is written to stderr. `show`: whether it is shown at all.
    """
    notebook = NotebookCell() if show and in_notebook() else None
    live = notebook is None and _is_terminal(sys.stderr)
    every_s = REDRAW_EVERY_S if live or notebook else LINE_EVERY_S
    shown_s = clock() if not live else -every_s

    def show_text(text: str) -> None:
        nonlocal shown_s
        if show and clock() - shown_s >= every_s:
            shown_s = clock()
            if notebook is not None:
                notebook.show(f"{doing}: {text}", escape(f"{doing}: {text}"))
            else:
                _write_to_stderr(f"\r\x1b[K{doing}: {text}" if live else f"{doing}: {text}\n")

    try:
        yield show_text
    finally:
        if notebook is not None:
            notebook.clear()
        elif live and show:
            _write_to_stderr("\r\x1b[K")


def in_notebook() -> bool:
    """Whether this program is a notebook's kernel (ipykernel). IPython on a terminal is a terminal."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return getattr(shell, "kernel", None) is not None


def _is_terminal(stream: TextIO | None) -> bool:
    """Whether a stream is a terminal. A user's program may have closed it, or replaced it with anything."""
    try:
        return stream is not None and stream.isatty()
    except (AttributeError, ValueError, OSError):
        return False


def _write_to_stderr(text: str) -> None:
    """Write, or drop what cannot be written."""
    with suppress(AttributeError, ValueError, OSError):
        sys.stderr.write(text)
        sys.stderr.flush()


def _view(log_json: bool) -> tuple[ProgressView, float]:
    """The way to show progress here, and how many seconds pass between two."""
    if log_json:
        return JsonEvents(), LINE_EVERY_S
    if in_notebook():
        return NotebookBlock(NotebookCell()), NOTEBOOK_EVERY_S
    if _is_terminal(sys.stdout):
        return LiveBlock(Console()), REDRAW_EVERY_S
    return PlainLines(), LINE_EVERY_S


class DroppingView:
    """Shows what can be shown, and drops the rest: standard output may be full, closed, or anything the user put there."""

    def __init__(self, view: ProgressView) -> None:
        self._view = view

    def show(self, progress: Progress) -> None:
        """Show this progress now."""
        with suppress(Exception):
            self._view.show(progress)

    def print_line(self, line: str) -> None:
        """Print a line that is not redrawn."""
        with suppress(Exception):
            self._view.print_line(line)

    def close(self) -> None:
        """Restore the terminal."""
        with suppress(Exception):
            self._view.close()


class RateLimitedView:
    """Shows the first progress, then at most one in `every_s`, and the last one. A new note is printed at once.

    While the run makes no update, lines that are not redrawn come ever less often.
    """

    def __init__(self, view: ProgressView, every_s: float, clock: Callable[[], float]) -> None:
        self._view, self._every_s, self._clock = view, every_s, clock
        self._shown_s = -every_s
        self._waiting: Progress | None = None
        self._updates, self._updated_s = -1, 0.0  # number of updates, and since when it is this one
        self._note = ""

    def __call__(self, progress: Progress) -> None:
        """Take a new progress of the run."""
        if progress.note and progress.note != self._note:
            self._view.print_line(progress.note)
        self._note = progress.note
        self._waiting = progress
        if progress.updates != self._updates:
            self._updates, self._updated_s = progress.updates, self._clock()
        seldom_s = (self._clock() - self._updated_s) / 2 if self._every_s >= LINE_EVERY_S else 0.0
        if self._clock() - self._shown_s >= max(self._every_s, seldom_s):
            self._show()

    def close(self) -> None:
        """Show the last progress, if it was not shown yet."""
        self._show()

    def _show(self) -> None:
        if self._waiting is not None:
            self._view.show(self._waiting)
            self._waiting, self._shown_s = None, self._clock()


class PlainLines:
    """Plain lines, for logs, pipes and batch systems."""

    def show(self, progress: Progress) -> None:
        """Print one line."""
        parts = [f"{progress.env_steps:,} of {progress.total_steps:,} env steps", *main_figures(progress).values()]
        parts += [progress.waiting] if progress.waiting else []
        self.print_line(" | ".join(parts))

    def print_line(self, line: str) -> None:
        """Print the line."""
        print(escaped(line), flush=True)

    def close(self) -> None:
        """Nothing to do."""


class NotebookCell:
    """One display of a notebook's cell, which is updated in place."""

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, text: str, html: str) -> None:
        """Show this instead of what was shown before. `text` is for where no HTML can be shown."""
        content = {"text/plain": text, "text/html": html}
        if self._handle is None:
            from IPython.display import display

            self._handle = display(content, raw=True, display_id=True)
        else:
            self._handle.update(content, raw=True)

    def clear(self) -> None:
        """Show nothing."""
        if self._handle is not None:
            self.show("", "")


class NotebookBlock:
    """A block that is updated in the cell's output. Notes are printed below it."""

    def __init__(self, cell: NotebookCell) -> None:
        self._cell = cell

    def show(self, progress: Progress) -> None:
        """Update the block."""
        figures = [f"{progress.env_steps:,} of {progress.total_steps:,} env steps", *main_figures(progress).values()]
        cells = [(escape(name), escape(escaped(text))) for name, text in detail_rows(progress).items()]
        left = "style='text-align:left'"
        rows = "".join(f"<tr><td {left}>{name}</td><td {left}>{text}</td></tr>" for name, text in cells)
        bar = f"<progress max='{max(1, progress.total_steps)}' value='{progress.env_steps}' style='width:20em'></progress>"
        head = " &nbsp; ".join(map(escape, figures))
        self._cell.show(" | ".join(figures), f"{bar}<div>{head}</div><table style='font-size:smaller'>{rows}</table>")

    def print_line(self, line: str) -> None:
        """Print the line."""
        print(escaped(line), flush=True)

    def close(self) -> None:
        """Leave the block as it is."""


class JsonEvents:
    """JSON lines on stderr, for programs."""

    def show(self, progress: Progress) -> None:
        """Print one line."""
        sys.stderr.write(f"{progress_line(progress, time.time())}\n")

    def print_line(self, line: str) -> None:
        """Do nothing: notes are part of the progress, and the log has its own handler."""

    def close(self) -> None:
        """Nothing to do."""


def _json_log_handler() -> logging.Handler:
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines())
    return handler


class LiveBlock:
    """A block that is redrawn in place on a terminal."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False)
        self._live.start()

    def show(self, progress: Progress) -> None:
        """Redraw the block."""
        self._live.update(render_block(progress), refresh=True)

    def print_line(self, line: str) -> None:
        """Print the line above the block."""
        self._console.print(escaped(line), markup=False, highlight=False)

    def close(self) -> None:
        """Leave the block as it is and show the cursor again."""
        self._live.stop()


def main_figures(progress: Progress) -> dict[str, str]:
    """The most important figures, as text by name."""
    expected = progress.workers_expected
    score = "none yet" if progress.return_mean is None else f"{progress.return_mean:,.1f}"
    return {
        "speed": f"{progress.steps_per_s:,.0f} steps/s",
        "return": f"return {score}",
        "lag": f"lag {progress.lag_mean:.1f} (max {progress.lag_max})",
        "workers": f"workers {progress.workers_alive}" + (f" of {expected}" if expected else ""),
        "update": f"update {progress.updates:,}",
    }


def render_block(progress: Progress) -> RenderableType:
    """A progress bar, the main figures, where the time goes, what became of tickets and transitions, the run folder."""
    done = min(1.0, progress.env_steps / progress.total_steps) if progress.total_steps else 0.0
    bar = Table.grid(padding=(0, 1))
    bar.add_row(
        ProgressBar(total=1.0, completed=done, width=34, complete_style="cyan", finished_style="green"),
        Text(f"{done:4.0%}", style="bold"),
        Text(f"{progress.env_steps:,} of {progress.total_steps:,} env steps"),
        Text(_elapsed_and_left(progress, done), style="dim"),
    )
    head = Text("   ").join(_styled(name, text, progress) for name, text in main_figures(progress).items())
    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="dim", no_wrap=True)
    rows.add_column(overflow="fold")
    for name, text in detail_rows(progress).items():
        rows.add_row(name, Text(escaped(text)))
    return Group(bar, head, rows)


def detail_rows(progress: Progress) -> dict[str, str]:
    """The details, as text by name: each stage's share of the time, counts that are not zero, the run folder."""
    rows = {"now": progress.waiting} if progress.waiting else {}
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
    """The unit of a count of the ledger: transitions or messages by its prefix, else tickets."""
    first, _, rest = name.partition("_")
    return first if rest and first in ("transitions", "messages") else "tickets"


def _elapsed_and_left(progress: Progress, done: float) -> str:
    steps = progress.total_steps - progress.env_steps
    if done >= 1 or not progress.steps_per_s:
        return f"{_clock_time(progress.wall_s)} in all"
    return f"{_clock_time(progress.wall_s)}, {_clock_time(steps / progress.steps_per_s)} left"


def _clock_time(seconds: float) -> str:
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02}:{s:02}" if hours else f"{m}:{s:02}"


def _styled(name: str, text: str, progress: Progress) -> Text:
    running = progress.env_steps < progress.total_steps
    missing = name == "workers" and running and progress.workers_alive < progress.workers_expected
    return Text(text, style={"return": "bold green"}.get(name, "bold yellow" if missing else "bold"))


class _WarningHandler(logging.Handler):
    """Prints warnings, errors and notices of the log in the view."""

    def __init__(self, view: ProgressView) -> None:
        super().__init__(logging.WARNING)
        self._view = view

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record, unless the progress shows the same."""
        if getattr(record, "in_progress", False):
            return
        level = "" if is_notice(record) else f"{record.levelname.lower()}: "
        self._view.print_line(f"{level}{record.getMessage()}")
