"""Building blocks of the page's sections, as HTML text. Pure."""

from __future__ import annotations

from html import escape

from learner.report.charts import COLORS, MINUS
from learner.report.reported_runs import RunGroup


def section(name: str, about: str, content: str) -> str:
    """A section of the page with a heading. `content` is HTML; `name` and `about` are text."""
    introduction = f"<p>{escape(about)}</p>" if about else ""
    return f"<section><h2>{escape(name)}</h2>{introduction}{content}</section>"


def color_dot(group: RunGroup) -> str:
    """A dot in the color of a group."""
    return f'<i class="dot c{group.color % COLORS}"></i>'


def return_text(value: float) -> str:
    """A return with one decimal and a typographic minus sign."""
    return f"{value:,.1f}".replace("-", MINUS)


def time_text(seconds: float) -> str:
    """A duration in s, min or h."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
