"""Markdown tables of the reference pages. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table. A cell may hold Markdown in one line."""
    lines = [head, ["---"] * len(head), *([cell(one) for one in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def cell(text: str) -> str:
    """A text as it may stand in a cell: in one line, and without a bar that would end the cell."""
    return " ".join(text.split()).replace("|", "\\|")


def anchored(anchor: str, markdown: str) -> str:
    """Markdown that a link can lead to."""
    return f'<span id="{anchor}">{markdown}</span>'
