"""The site's style: on a narrow screen, a long name in the first column of a table leaves room for the other columns."""

from __future__ import annotations

import re

from website.pages import ROOT


def test_names_in_tables_are_broken_on_a_narrow_screen() -> None:
    style = (ROOT / "docs" / "site.css").read_text()
    for_all = re.sub(r"@media[^{]*\{(?:[^{}]*\{[^{}]*\})*\s*\}", "", style)
    assert "nowrap" in style
    assert "nowrap" not in for_all
    (rule,) = re.findall(r"td:first-child code \{([^}]*)\}", for_all)
    assert "overflow-wrap: anywhere" in rule
