"""The pages that the tests read, and the blocks of code in them."""

from __future__ import annotations

import re
from functools import cache
from typing import NamedTuple

from website.links import FENCE, outside_fences
from website.pages import FROM_ELSEWHERE, MADE, ROOT

WITHOUT_CHECKS_OF_COMMANDS = {"CHANGELOG.md"}
"""Pages that also name what was there once"""
COMMENT = re.compile(r"<!-- (.*) -->")


class Block(NamedTuple):
    """A fenced block of code."""

    line: int
    """of the page, at which its first line stands, from 1"""
    language: str
    text: str
    about: str
    """what the comment in the line before it says, which readers do not see"""


@cache
def written() -> dict[str, str]:
    """The text of each page that someone wrote, by its path in the repository."""
    paths = [
        *ROOT.glob("docs/**/*.md"),
        *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "benchmarks/README.md")),
    ]
    paths += [ROOT / "protocol" / "README.md", ROOT / "examples" / "README.md"]
    return {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in sorted(paths)}


@cache
def made() -> dict[str, str]:
    """The text of each page that is made from the code, by the path that it would have in the repository."""
    return {f"docs/{page}": make() for page, make in MADE.items()}


def in_the_site() -> dict[str, str]:
    """The texts of files that the site has elsewhere, by the path that they would have in the repository."""
    return {f"docs/{page}": written()[source] for source, page in FROM_ELSEWHERE.items()}


def manuals() -> dict[str, str]:
    """The written pages that tell users what to do now."""
    return {path: text for path, text in written().items() if path not in WITHOUT_CHECKS_OF_COMMANDS}


def blocks(text: str) -> list[Block]:
    """The fenced blocks of a page."""
    lines = text.split("\n")
    plain = {number for number, _ in outside_fences(text)}
    found: list[Block] = []
    opened: tuple[int, str] | None = None
    for number, line in enumerate(lines, 1):
        if number in plain:
            continue
        if opened is None:
            mark = FENCE.match(line)
            assert mark is not None, line
            opened = number, line.strip().lstrip("`~").strip()
        elif FENCE.match(line) and line.strip().strip("`~") == "":
            indent = " " * (len(line) - len(line.lstrip()))  # of a tab or a list
            inside = [text.removeprefix(indent) for text in lines[opened[0] : number - 1]]
            about = COMMENT.fullmatch(lines[opened[0] - 2].strip()) if opened[0] > 1 else None
            found.append(Block(opened[0] + 1, opened[1], "\n".join(inside), about[1] if about else ""))
            opened = None
    return found


def code_spans(text: str) -> list[tuple[int, str]]:
    """Line and content of each piece of code between backticks."""
    return [
        (number, match[1].strip())
        for number, line in outside_fences(text)
        for match in re.finditer(r"(?<!`)`([^`\n]+)`(?!`)", line)
    ]
