"""The pages of the site: those in docs/, files from elsewhere in the repository, and those generated from the code.

Rule: a link to a repository file that isn't a page becomes plain code, because the repository has no public address. A link
to a file that doesn't exist is an error.
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
"""Paths in the repository whose links lead to another page of the site"""
MADE: dict[str, Callable[[], str]] = {
    **python_page.pages(),
}
"""Pages that are generated from the code when the site is built: path in the site -> function that makes the page"""
KEPT: dict[str, Callable[[], str]] = {
    "reference/settings.md": settings_page.page,
    "reference/commands.md": commands_page.page,
    "reference/metrics.md": metrics_page.page,
}
"""Pages that are generated from the code and kept in docs/, so that links to them also work in the repository"""


class DeadLink(Exception):
    """A link to a file that doesn't exist."""


def written_pages() -> dict[str, str]:
    """The hand-written pages: path in the site -> path in the repository."""
    found = {str(path.relative_to(ROOT / "docs")): str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")}
    return found | {page: source for source, page in FROM_ELSEWHERE.items()}


def for_site(page: str, source: str, text: str) -> str:
    """The text of a page, with links as the site needs them. Raises DeadLink for a link to a file that doesn't exist.

    `source`: the path of the file in the repository. A link to a missing page in docs/ is left to mkdocs, which reports it.
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
    """The page or picture that a repository file becomes in the site; None if it isn't part of the site."""
    if path in START:
        return START[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return FROM_ELSEWHERE.get(path)


def as_code(text: str, path: str) -> str:
    """The replacement for a link to a file: the file's path, preceded by the link's text if that says more."""
    name = text.strip("`")
    return f"`{path}`" if name in (path, posixpath.basename(path), f"{path}/") else f"{text} (`{path}`)"


if __name__ == "__main__":  # python -m website.pages: `make docs`
    for kept, make in KEPT.items():
        (ROOT / "docs" / kept).write_text(make(), encoding="utf-8")
