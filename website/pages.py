"""The pages of the site: those of docs/, files from elsewhere in the repository, and those made from the code.

Rule: a link to a file of the repository that is no page becomes plain code, because the repository has no public address.
A link to a file that does not exist is an error.
"""

from __future__ import annotations

import posixpath
from collections.abc import Callable
from pathlib import Path

from website import commands_page, metrics_page, python_page, settings_page
from website.links import Link, elsewhere, resolved, with_links

ROOT = Path(__file__).parent.parent
FROM_ELSEWHERE = {
    "README.md": "index.md",
    "protocol/README.md": "reference/wire.md",
    "CHANGELOG.md": "project/changelog.md",
    "CONTRIBUTING.md": "project/contributing.md",
}
"""Files outside docs/ that are pages: path in the repository -> path in the site"""
START = {"docs": "index.md"}
"""What links to these files becomes a link to this page."""
MADE: dict[str, Callable[[], str]] = {
    **python_page.pages(),
}
"""Pages that are made from the code when the site is built: path in the site -> what makes it"""
KEPT: dict[str, Callable[[], str]] = {
    "reference/settings.md": settings_page.page,
    "reference/commands.md": commands_page.page,
    "reference/metrics.md": metrics_page.page,
}
"""Pages that are made from the code and kept in docs/, so that links lead to them in the repository too"""


class DeadLink(Exception):
    """A link to a file that does not exist."""


def written_pages() -> dict[str, str]:
    """The pages that someone wrote: path in the site -> path in the repository."""
    found = {str(path.relative_to(ROOT / "docs")): str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")}
    return found | {page: source for source, page in FROM_ELSEWHERE.items()}


def for_site(page: str, source: str, text: str) -> str:
    """The text of a page with its links as the site needs them. Raises DeadLink for a file that does not exist.

    `source`: the path of the file in the repository. A link to a page of docs/ that is missing is left to mkdocs, which
    reports it.
    """

    def new(link: Link, markdown: str) -> str:
        if elsewhere(link.target) or link.target.startswith("#"):
            return markdown
        path, anchor = resolved(source, link.target)
        if (inside := page_of(path)) is not None:
            target = posixpath.relpath(inside, posixpath.dirname(page)) + (f"#{anchor}" if anchor else "")
            return markdown.replace(f"]({link.target})", f"]({target})")
        if path.startswith("../") or not (ROOT / path).exists():
            raise DeadLink(f"{source}: link to {link.target}: there is no file {path}")
        return as_code(link.text, path)

    return with_links(text, new)


def page_of(path: str) -> str | None:
    """The page or picture of the site that a file of the repository becomes; None if it becomes none."""
    if path in START:
        return START[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return FROM_ELSEWHERE.get(path)


def as_code(text: str, path: str) -> str:
    """What stands in place of a link to a file: its path, after the text of the link if that says more."""
    name = text.strip("`")
    return f"`{path}`" if name in (path, posixpath.basename(path), f"{path}/") else f"{text} (`{path}`)"


if __name__ == "__main__":  # python -m website.pages: `make docs`
    for kept, make in KEPT.items():
        (ROOT / "docs" / kept).write_text(make(), encoding="utf-8")
