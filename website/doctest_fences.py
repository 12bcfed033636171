"""Turns doctest-style examples into fenced Markdown blocks. Pure.

Rule: an example begins with a line `>>>` and ends with an empty line or the end of the docstring.
"""

from __future__ import annotations


def with_fences(text: str) -> str:
    """The docstring, with each example in a fenced block."""
    lines: list[str] = []
    indent: str | None = None
    for line in text.split("\n"):
        if indent is None and line.lstrip().startswith(">>> "):
            indent = line[: len(line) - len(line.lstrip())]
            lines.append(f"{indent}```pycon")
        elif indent is not None and not line.strip():
            lines.append(f"{indent}```")
            indent = None
        lines.append(line)
    if indent is not None:
        lines.append(f"{indent}```")
    return "\n".join(lines)
