"""The site's style on a narrow screen: a long name leaves room for other columns, and rows of wide tables are cards."""

from __future__ import annotations

import re

from website.pages import ROOT
from website.tables import as_cards


def test_names_in_tables_are_broken_on_a_narrow_screen() -> None:
    style = (ROOT / "docs" / "site.css").read_text()
    for_all = re.sub(r"@media[^{]*\{(?:[^{}]*\{[^{}]*\})*\s*\}", "", style)
    assert "nowrap" in style
    assert "nowrap" not in for_all
    (rule,) = re.findall(r"td:first-child code \{([^}]*)\}", for_all)
    assert "overflow-wrap: anywhere" in rule


def test_cells_of_a_wide_table_name_their_columns() -> None:
    head = "<thead><tr><th></th><th>of <code>us</code></th><th>of others</th></tr></thead>"
    html = f"<p><table>{head}<tbody><tr><td>speed</td><td>1</td><td>2</td></tr></tbody></table></p>"
    cells = '<td data-label="">speed</td><td data-label="of us">1</td><td data-label="of others">2</td>'
    assert as_cards(html) == f'<p><table class="cards">{head}<tbody><tr>{cells}</tr></tbody></table></p>'
    narrow = "<table><tr><th>a</th><th>b</th></tr><tr><td>1</td><td>2</td></tr></table>"
    assert as_cards(narrow) == narrow
