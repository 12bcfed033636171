"""Finds the links and headings in Markdown text. Pure.

Rule: text in a fenced code block or between backticks is neither a link nor a heading.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Iterator
from typing import NamedTuple

FENCE = re.compile(r"^ {0,8}(```+|~~~+)")
LINK = re.compile(r"(?P<image>!?)\[(?P<text>(?:`[^`]*`|[^\[\]`])*)\]\((?P<target>[^()\s]*(?:\([^()\s]*\)[^()\s]*)?)\)")
CODE = re.compile(r"(`+)(?!`).*?(?<!`)\1(?!`)")
HEADING = re.compile(r"^#{1,6}\s+(?P<title>.*?)\s*#*\s*$")
OWN_ANCHOR = re.compile(r"""(?:\b(?:id|name)=["'](?P<html>[^"']+)["'])|(?:\{[^}]*#(?P<attribute>[\w.-]+)[^}]*\}\s*$)""")
ELSEWHERE = re.compile(r"^[a-z][a-z0-9+.-]*:")


class Link(NamedTuple):
    """A link on a page."""

    line: int
    text: str
    target: str


def outside_fences(text: str) -> Iterator[tuple[int, str]]:
    """The lines that aren't in a fenced code block, with their line numbers, counted from 1."""
    fence = ""
    for number, line in enumerate(text.split("\n"), 1):
        mark = FENCE.match(line)
        if mark and not fence:
            fence = mark[1]
        elif mark and mark[1].startswith(fence) and line.strip() == mark[1]:
            fence = ""
        elif not fence:
            yield number, line


def links(text: str) -> list[Link]:
    """All links and images on a page, including those to other hosts."""
    found: list[Link] = []

    def note(match: re.Match[str]) -> str:
        found.append(Link(text.count("\n", 0, match.start()) + 1, match["text"], match["target"]))
        return match[0]

    _substituted(text, note)
    return found


def with_links(text: str, new: Callable[[Link, str], str]) -> str:
    """The text with each link replaced. `new` gets the link and its Markdown, and returns the new Markdown."""
    return _substituted(text, lambda match: new(Link(0, match["text"], match["target"]), match[0]))


def _substituted(text: str, new: Callable[[re.Match[str]], str]) -> str:
    """The text after `new` has replaced each link. A link may span lines; code stays unchanged."""
    code = _code_spans(text)
    return LINK.sub(lambda match: match[0] if any(a <= match.start() < b for a, b in code) else new(match), text)


def _code_spans(text: str) -> list[tuple[int, int]]:
    """Where code begins and ends: each fenced block, and each part of a line between backticks."""
    plain = {number for number, _ in outside_fences(text)}
    spans: list[tuple[int, int]] = []
    start = 0
    for number, line in enumerate(text.split("\n"), 1):
        if number in plain:
            spans += [(start + match.start(), start + match.end()) for match in CODE.finditer(line)]
        else:
            spans.append((start, start + len(line)))
        start += len(line) + 1
    return spans


def elsewhere(target: str) -> bool:
    """Whether this is an address on another host, or an email address."""
    return bool(ELSEWHERE.match(target))


def resolved(source: str, target: str) -> tuple[str, str]:
    """The path in the repository, and the anchor, of a relative link in the file `source`. `..` may lead outside."""
    path, _, anchor = target.partition("#")
    return (posixpath.normpath(posixpath.join(posixpath.dirname(source), path)) if path else source), anchor


def slug(title: str, separator: str = "-") -> str:
    """The anchor of a heading, as on GitHub: lower case, letters, digits and `_`, with a dash for each space."""
    return re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", separator)


def headings(text: str) -> list[str]:
    """The titles on a page, without Markdown."""
    matches = (HEADING.match(line) for _, line in outside_fences(text))
    return [_plain(match["title"]) for match in matches if match]


def anchors(text: str) -> set[str]:
    """All anchors on a page: those of its headings (a repeated title gets a number), and explicit ones."""
    found: set[str] = set()
    for title in headings(text):
        name = slug(title)
        number = 0
        while (anchor := f"{name}_{number}" if number else name) in found:
            number += 1
        found.add(anchor)
    for _, line in outside_fences(text):
        found |= {match["html"] or match["attribute"] for match in OWN_ANCHOR.finditer(line)}
    return found


def _plain(title: str) -> str:
    """A title without the Markdown for links, code and emphasis."""
    return re.sub(r"[`*]", "", LINK.sub(lambda match: match["text"], re.sub(r"\s*\{[^}]*\}$", "", title)))
