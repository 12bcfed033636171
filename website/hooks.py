"""Hooks for mkdocs (mkdocs.yml names this file): pages from outside docs/, pages generated from the code, and links."""

from __future__ import annotations

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from website.pages import FROM_ELSEWHERE, MADE, ROOT, DeadLink, for_site, written_pages
from website.tables import as_cards

LOOKED_UP = ("reference/", "project/")
"""Pages that a search lists last, because their many names would hide the page that answers the question."""


def on_files(files: Files, /, *, config: MkDocsConfig) -> Files:
    """Add the pages that aren't in docs/."""
    for source, page in FROM_ELSEWHERE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    for page, make in MADE.items():
        files.append(File.generated(config, page, content=make()))
    return files


def on_page_markdown(markdown: str, /, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite the links on a page. Raises PluginError for a link to a file that doesn't exist."""
    path = page.file.src_uri
    if path.startswith(LOOKED_UP):
        page.meta["search"] = {"boost": 0.2}
    try:
        return for_site(path, written_pages().get(path, f"docs/{path}"), markdown)
    except DeadLink as error:
        raise PluginError(str(error)) from None


def on_page_content(html: str, /, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Label each table cell with its column's name, for narrow screens."""
    return as_cards(html)
