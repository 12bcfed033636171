"""Markdown tables: of docs/explanation/results.md and of the pages that `website` makes. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table. A cell may hold Markdown in one line."""
    lines = [f"| {' | '.join(line)} |" for line in (head, *([cell(one) for one in row] for row in rows))]
    return "\n".join([lines[0], f"|{'---|' * len(head)}", *lines[1:]]) + "\n"


def cell(text: str) -> str:
    """A text as it may stand in a cell: in one line, and without a bar that would end the cell."""
    return " ".join(text.split()).replace("|", "\\|")
