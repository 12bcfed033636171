"""Small parts of which the page's sections are made, as HTML text. Pure."""

from __future__ import annotations

from html import escape

from learner.report.charts import COLOURS, MINUS
from learner.report.runs import Line


def section(name: str, about: str, content: str) -> str:
    """A card of the page."""
    said = f"<p>{escape(about)}</p>" if about else ""
    return f"<section><h2>{escape(name)}</h2>{said}{content}</section>"


def dot(line: Line) -> str:
    """A dot in the colour of a line."""
    return f'<i class="dot c{line.colour % COLOURS}"></i>'


def return_text(value: float) -> str:
    """To a tenth, with a minus as long as a plus."""
    return f"{value:,.1f}".replace("-", MINUS)


def time_text(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
