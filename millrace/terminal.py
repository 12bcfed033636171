"""Shows the progress of a run: as a live block on a terminal, as one display in a notebook, as lines elsewhere, or as JSON.

Rule: showing progress never slows the run (at most five redraws a second), and the last progress is always shown. Warnings
in the log are shown above the block. No text is interpreted as markup or terminal control.
`millrace.learner.standard_streams` ensures that a full or closed stream doesn't end the run.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from html import escape
from typing import Any, TextIO

from rich.console import Console, Group, RenderableType
from rich.constrain import Constrain
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from millrace.learner.rollouts.opponent_pool import ELO_KEY
from millrace.learner.run_folder.json_log import JsonLines, progress_line
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.results import ALL_STEPS_DONE
from millrace.learner.run_folder.sentences import (
    bottleneck,
    ending,
    lag_in_words,
    per_second,
    percent,
    return_in_words,
    slowest_part,
    steps_in_words,
    went_wrong,
    who_waits,
    workers_in_words,
)
from millrace.protocol.bounds import escaped, one_line
from millrace.protocol.logs.notices import is_notice
from millrace.protocol.specs import SCORE
from millrace.sparkline import ASCII, BLOCKS, Sparkline

REDRAW_EVERY_S = 0.2
NOTEBOOK_EVERY_S = 0.5
LINE_EVERY_S = 5.0
GAP = "   "  # separates the figures in a row
MOST_REASON = 80  # characters to show of the reason why a run ended; an error also gets its own line below the block


class ProgressView:
    """A way to show progress. By default, its methods do nothing."""

    def show(self, progress: Progress) -> None:
        """Show this progress now."""

    def print_line(self, line: str) -> None:
        """Print a line that stays, unlike the redrawn block."""

    def close(self) -> None:
        """Restore the terminal."""


@contextmanager
def progress_view(
    log_json: bool = False, clock: Callable[[], float] = time.monotonic, *, may_fail: bool = True
) -> Iterator[Callable[[Progress], None]]:
    """A context manager that yields a function to call with each progress.

    Within the context, millrace's log is shown too. `may_fail`: raise exceptions that occur while progress is shown;
    otherwise ignore them.
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
def count_line(
    doing: str, clock: Callable[[], float] = time.monotonic, *, show: bool = True
) -> Iterator[Callable[[str], None]]:
    """A context manager that yields a function. To show `doing` followed by a text, call the function with the text.

    On a terminal or in a notebook, the text is updated in place; elsewhere, a line is printed now and then. Outside a
    notebook, the text goes to stderr. `show`: whether to show anything at all.
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
    """Whether this program is a notebook's kernel (ipykernel). IPython on a terminal counts as a terminal."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return getattr(shell, "kernel", None) is not None


def _is_terminal(stream: TextIO | None) -> bool:
    """Whether a stream is a terminal. The user's program may have closed it, or replaced it with another object."""
    try:
        return stream is not None and stream.isatty()
    except (AttributeError, ValueError, OSError):
        return False


def _write_to_stderr(text: str) -> None:
    """Write the text, or drop it if that fails."""
    with suppress(AttributeError, ValueError, OSError):
        sys.stderr.write(text)
        sys.stderr.flush()


def _view(log_json: bool) -> tuple[ProgressView, float]:
    """The view for this program's output, and the minimum number of seconds between two of its updates."""
    if log_json:
        return JsonEvents(), LINE_EVERY_S
    if in_notebook():
        return NotebookBlock(NotebookCell()), NOTEBOOK_EVERY_S
    if _is_terminal(sys.stdout):
        return LiveBlock(Console()), REDRAW_EVERY_S
    return PlainLines(), LINE_EVERY_S


class DroppingView(ProgressView):
    """Wraps another view and ignores its exceptions: standard output may be full, closed, or replaced by the user."""

    def __init__(self, view: ProgressView) -> None:
        self._view = view

    def show(self, progress: Progress) -> None:
        """Show this progress now."""
        with suppress(Exception):
            self._view.show(progress)

    def print_line(self, line: str) -> None:
        """Print a line that stays, unlike the redrawn block."""
        with suppress(Exception):
            self._view.print_line(line)

    def close(self) -> None:
        """Restore the terminal."""
        with suppress(Exception):
            self._view.close()


class RateLimitedView:
    """Shows the first progress, then at most one every `every_s` seconds, and always the last one.

    A new note is printed at once. A view that prints lines prints them at growing intervals while there is no update.
    """

    def __init__(self, view: ProgressView, every_s: float, clock: Callable[[], float]) -> None:
        self._view = view
        self._every_s = every_s
        self._clock = clock
        self._shown_s = -every_s
        self._waiting: Progress | None = None
        self._updates = -1
        self._updated_s = 0.0  # when the number of updates last changed
        self._note = ""

    def __call__(self, progress: Progress) -> None:
        """Show this progress, now or later, unless a newer one replaces it."""
        if progress.note and progress.note != self._note:
            self._view.print_line(progress.note)
        self._note = progress.note
        self._waiting = progress
        if progress.updates != self._updates:
            self._updates = progress.updates
            self._updated_s = self._clock()
        seldom_s = (self._clock() - self._updated_s) / 2 if self._every_s >= LINE_EVERY_S else 0.0
        if self._clock() - self._shown_s >= max(self._every_s, seldom_s):
            self._show()

    def close(self) -> None:
        """Show the last progress, if it hasn't been shown yet."""
        self._show()

    def _show(self) -> None:
        if self._waiting is not None:
            self._view.show(self._waiting)
            self._waiting = None
            self._shown_s = self._clock()


class PlainLines(ProgressView):
    """Plain lines, for logs, pipes and batch systems."""

    def show(self, progress: Progress) -> None:
        """Print one line. When the run has ended, the line also names the slowest part and what went wrong."""
        ended = bool(progress.stop_reason)
        said = slowest_part(progress.stages) if ended else who_waits(progress)
        parts = [main_figures(progress), said, went_wrong(progress.ledger) if ended else ""]
        self.print_line(" | ".join(filter(None, parts)))

    def print_line(self, line: str) -> None:
        """Print the line."""
        print(escaped(line), flush=True)


class NotebookCell:
    """One display in the output of a notebook's cell, which is updated in place."""

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, text: str, html: str) -> None:
        """Replace the content of the display. `text` is for notebooks that can't show HTML."""
        content = {"text/plain": text, "text/html": html}
        if self._handle is None:
            from IPython.display import display

            self._handle = display(content, raw=True, display_id=True)
        else:
            self._handle.update(content, raw=True)

    def clear(self) -> None:
        """Empty the display."""
        if self._handle is not None:
            self.show("", "")


class NotebookBlock(PlainLines):
    """A block that is updated in place in the cell's output. Notes are printed as lines below it."""

    def __init__(self, cell: NotebookCell) -> None:
        self._cell = cell
        self._returns = Sparkline()

    def show(self, progress: Progress) -> None:
        """Update the block."""
        self._returns.add(progress.env_steps, progress.return_mean)
        share, head = how_far(progress)
        cells = [(escape(name), escape(escaped(text))) for name, text in block_rows(progress, self._returns).items()]
        left = "style='text-align:left'"
        rows = "".join(f"<tr><td {left}>{name}</td><td {left}>{text}</td></tr>" for name, text in cells)
        total = max(1, progress.total_steps)
        bar = "" if share is None else f"<progress max='{total}' value='{share * total:.0f}' style='width:20em'></progress> "
        html = f"<div>{bar}{escape(escaped(head))}</div><table style='font-size:smaller'>{rows}</table>"
        self._cell.show(main_figures(progress), html)


class JsonEvents(ProgressView):
    """JSON lines on stderr, for programs. Each line contains the progress's note; another handler writes the log."""

    def show(self, progress: Progress) -> None:
        """Print one line."""
        sys.stderr.write(f"{progress_line(progress, time.time())}\n")


def _json_log_handler() -> logging.Handler:
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines())
    return handler


class LiveBlock(ProgressView):
    """A block that is redrawn in place on a terminal."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._returns = Sparkline(ASCII if console.options.ascii_only else BLOCKS)
        self._live = Live(console=console, auto_refresh=False)
        self._live.start()

    def show(self, progress: Progress) -> None:
        """Redraw the block."""
        self._returns.add(progress.env_steps, progress.return_mean)
        room = self._console.width - 2  # room for the terminal's ^C, which would otherwise begin a new line
        self._live.update(Constrain(render_block(progress, self._returns), room), refresh=True)

    def print_line(self, line: str) -> None:
        """Print the line above the block."""
        self._console.print(escaped(line), markup=False, highlight=False)

    def close(self) -> None:
        """Leave the block as it is and show the cursor again."""
        self._live.stop()


def main_figures(progress: Progress) -> str:
    """The most important figures in one line."""
    figures = [
        f"{steps_in_words(progress)} env steps",
        f"{per_second(progress.steps_per_s)} steps/s",
        f"return {return_in_words(progress.return_mean)}",
        _strength(progress),
        lag_in_words(progress),
        f"workers {workers_in_words(progress)}",
        f"update {progress.updates:,}",
    ]
    return " | ".join(filter(None, figures))


def block_rows(progress: Progress, returns: Sparkline) -> dict[str, str]:
    """The rows of a block below its head, as text by name. `returns`: the curve of returns so far."""
    best = progress.best
    speed = f"{per_second(progress.steps_per_s)} a second"
    evaluated = "" if best is None else f"best evaluation {best[0]:,.1f} at {best[1]:,} env steps"
    rows = {
        "env steps": GAP.join((steps_in_words(progress), speed, f"update {progress.updates:,}")),
        "return": GAP.join(filter(None, (return_in_words(progress.return_mean), str(returns), evaluated))),
        "opponents": _strength(progress),
        "workers": GAP.join(filter(None, (workers_in_words(progress), lag_in_words(progress)))),
        "time": bottleneck(progress),
        "lost": went_wrong(progress.ledger),
        "run": progress.run,
    }
    return {name: text for name, text in rows.items() if text}


def how_far(progress: Progress) -> tuple[float | None, str]:
    """The share of the run that is done, from 0 to 1, and a text about it.

    If the run ended early, the share is None, and the text says why it ended.
    """
    took = _clock_time(progress.wall_s)
    if progress.stop_reason == ALL_STEPS_DONE:
        return 1.0, f"100%  done in {took}"
    if progress.stop_reason:
        return None, ending(one_line(progress.stop_reason, MOST_REASON), f" after {took}", cut_short=progress.cut_short)
    left_s = progress.left_s or 0.0
    left = f", {_clock_time(left_s)} left" if left_s >= 1 else ""
    return progress.share, f"{percent(progress)}  {took}{left}"


def render_block(progress: Progress, returns: Sparkline) -> RenderableType:
    """The block: first a progress bar, or how the run ended; then the rows."""
    share, said = how_far(progress)
    head: RenderableType = Text(escaped(said), style="bold")
    if share is not None:
        bar = Table.grid(padding=(0, 1))
        bar.add_row(ProgressBar(total=1.0, completed=share, width=34, complete_style="cyan", finished_style="green"), head)
        head = bar
    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="dim", no_wrap=True)
    rows.add_column(overflow="fold")
    missing = not progress.stop_reason and progress.workers_alive < progress.workers_expected
    styles = {"return": "bold green", "workers": "bold yellow" if missing else ""}
    for name, text in block_rows(progress, returns).items():
        rows.add_row(name, Text(escaped(text), style=styles.get(name, "")))
    return Group(head, rows)


def _strength(progress: Progress) -> str:
    """Score and Elo rating against opponents; empty if there are none."""
    if (elo := progress.metrics.get(ELO_KEY)) is None:
        return ""
    return f"score {progress.facts[SCORE]}, Elo {elo:,.0f}"


def _clock_time(seconds: float) -> str:
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02}:{s:02}" if hours else f"{m}:{s:02}"


class _WarningHandler(logging.Handler):
    """Prints warnings, errors and notices from the log in the view."""

    def __init__(self, view: ProgressView) -> None:
        super().__init__(logging.WARNING)
        self._view = view

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record."""
        level = "" if is_notice(record) else f"{record.levelname.lower()}: "
        self._view.print_line(f"{level}{record.getMessage()}")
