"""Makes Markdown tables, for docs/explanation/results.md and the pages that `website` generates. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table. A cell may contain Markdown in one line."""
    lines = [f"| {' | '.join(line)} |" for line in (head, *([cell(one) for one in row] for row in rows))]
    return "\n".join([lines[0], f"|{'---|' * len(head)}", *lines[1:]]) + "\n"


def cell(text: str) -> str:
    """A text in the form that a cell may have: in one line, and with escaped bars, which would end the cell."""
    return " ".join(text.split()).replace("|", "\\|")
