"""All relative links of the pages lead to a file that exists, and all anchors to a heading. The nav has every page once.

`make site` checks the same with mkdocs, and also the links inside docstrings.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

import pytest

from tests.docs import pages
from website import python_page
from website.links import anchors, elsewhere, links, resolved, slug
from website.pages import FROM_ELSEWHERE, MADE, ROOT, DeadLink, as_code, for_site

NAV_PAGE = re.compile(r"^ *- (?:.*: )?([\w/-]+\.md)$", re.MULTILINE)


def dead_links(path: str, text: str, every: Mapping[str, str]) -> Iterator[str]:
    """What is wrong with the links of a page. `every`: the text of each page by its path in the repository."""
    for link in links(text):
        if elsewhere(link.target):
            continue
        target, anchor = resolved(path, link.target)
        if target not in every and (target.startswith("../") or not (ROOT / target).exists()):
            yield f"{path}:{link.line}: link to {link.target}: there is no {target}"
        elif anchor and target in every and anchor not in anchors_of(target, every[target]):
            yield f"{path}:{link.line}: link to {link.target}: {target} has no heading with the anchor #{anchor}"


def anchors_of(path: str, text: str) -> set[str]:
    return anchors(text) | python_page.anchors(path.removeprefix("docs/"))


def test_every_link_leads_somewhere() -> None:
    pytest.importorskip("stable_baselines3", reason="the page of the Python names has those of millrace.sb3")
    own = {**pages.written(), **pages.made()}
    every = {**own, **pages.in_the_site()}
    wrong = [line for path, text in own.items() for line in dead_links(path, text, every)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[a](no_such_page.md)", "there is no docs/no_such_page.md"),
        ("[a\nb](no_such_page.md)", "there is no docs/no_such_page.md"),
        ("![picture](images/no_such.png)", "there is no docs/images/no_such.png"),
        ("[a](../../outside.md)", "there is no ../outside.md"),
        ("[a](other.md#no-such-part)", "#no-such-part"),
        ("[a](#no-such-part)", "#no-such-part"),
        ("[a](reference/python/training.md#millrace.trian)", "#millrace.trian"),
        ("[`code`](no_such_page.md)", "there is no docs/no_such_page.md"),
    ],
)
def test_a_dead_link_is_found(text: str, complaint: str) -> None:
    every = {"docs/page.md": text, "docs/other.md": "# Other\n\n## A part", "docs/reference/python/training.md": ""}
    (line,) = dead_links("docs/page.md", text, every)
    assert complaint in line


def test_what_is_right_is_not_called_dead() -> None:
    text = (
        "# Top\n## A `part`, twice\n## A `part`, twice\n[a](#a-part-twice) [b](#a-part-twice_1) [c](../README.md)\n"
        "[d](other.md#x) [e](https://example.org/x.md) [f](../examples)\n"
        "```\n[g](nothing.md)\n# no heading\n```\n`[h](nothing.md)`"
    )
    every = {"docs/page.md": text, "docs/other.md": '<span id="x">here</span>'}
    assert not list(dead_links("docs/page.md", text, every))
    assert "no-heading" not in anchors(text)


def test_an_anchor_is_made_as_on_github() -> None:
    assert slug("What's new: `--max-lag` (2)") == "whats-new---max-lag-2"


def test_the_nav_has_every_page_once() -> None:
    listed = NAV_PAGE.findall((ROOT / "mkdocs.yml").read_text())
    there = [path.removeprefix("docs/") for path in pages.written() if path.startswith("docs/")]
    assert sorted(listed) == sorted([*there, *FROM_ELSEWHERE.values(), *MADE])


# -------------------------------------------------------------------- links in the site


def test_a_link_to_a_file_that_is_no_page_becomes_code() -> None:
    text = "See [own_loss.py](../../examples/own_loss.py), [the `Makefile`](../../Makefile) and [resume](resume.md#a)."
    expected = "See `examples/own_loss.py`, the `Makefile` (`Makefile`) and [resume](resume.md#a)."
    assert for_site("how-to/x.md", "docs/how-to/x.md", text) == expected


def test_links_of_a_page_from_elsewhere_are_made_to_fit() -> None:
    text = "[a](docs/how-to/resume.md#x) [b](protocol/README.md) [c](CHANGELOG.md) [d](README.md)"
    expected = "[a](../how-to/resume.md#x) [b](../reference/wire.md) [c](changelog.md) [d](../index.md)"
    assert for_site("project/contributing.md", "CONTRIBUTING.md", text) == expected


def test_a_link_to_a_file_that_does_not_exist_fails() -> None:
    with pytest.raises(
        DeadLink, match=r"docs/x\.md: link to \.\./learner/no_such\.py: there is no file learner/no_such\.py"
    ):
        for_site("x.md", "docs/x.md", "[a](../learner/no_such.py)")


def test_code_is_named_once() -> None:
    assert as_code("`examples/own_loss.py`", "examples/own_loss.py") == "`examples/own_loss.py`"
    assert as_code("an example", "examples/own_loss.py") == "an example (`examples/own_loss.py`)"
