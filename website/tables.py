"""Tables on the pages: anchors in their Markdown, and labels in their HTML for narrow screens. Pure.

Rule: on a phone, each row of a table with three or more columns is a card (docs/site.css), so a cell must name its column.
"""

from __future__ import annotations

import re

TABLE = re.compile(r"<table>.*?</table>", re.DOTALL)
ROW = re.compile(r"<tr>.*?</tr>", re.DOTALL)
HEAD_CELL = re.compile(r"<th[^>]*>(.*?)</th>", re.DOTALL)
TAG = re.compile(r"<[^>]+>")


def anchored(anchor: str, markdown: str) -> str:
    """The Markdown with an anchor, so that links can lead to it."""
    return f'<span id="{anchor}">{markdown}</span>'


def as_cards(html: str) -> str:
    """The page's HTML, with each table cell naming its column."""
    return TABLE.sub(lambda match: _labelled(match[0]), html)


def _labelled(table: str) -> str:
    names = [TAG.sub("", name).strip().replace('"', "&quot;") for name in HEAD_CELL.findall(table)]
    if len(names) < 3:
        return table

    def of_row(match: re.Match[str]) -> str:
        columns = iter(names)
        return re.sub("<td", lambda cell: f'<td data-label="{next(columns, "")}"', match[0])

    return ROW.sub(of_row, table).replace("<table>", '<table class="cards">', 1)
