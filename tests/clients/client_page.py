"""What `docs/how-to/write_a_client.md` writes: the files, and the client as it stands after each step.

Rule of the page: the comment above a block of Python names its file. A file is its blocks, one after another. A list item
that is a piece of code alone is the name of a check that passes after this step.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from tests.docs.pages import blocks
from tests.system.stage.processes import ROOT

PAGE = ROOT / "docs" / "how-to" / "write_a_client.md"
ENVIRONMENT = "grid_world.py"
CLIENT = "client.py"
CHECK = re.compile(r"^- `([^`]+)`$", re.MULTILINE)


class Step(NamedTuple):
    """The client after a step of the page."""

    title: str
    client: str
    checks: tuple[str, ...]
    """that pass from this step on"""


def client() -> str:
    """The whole client."""
    return _file(CLIENT, _page())


def steps() -> list[Step]:
    """The steps with checks."""
    found: list[Step] = []
    read = ""
    for section in _page().split("\n## "):
        read += f"{section}\n"
        if checks := CHECK.findall(section):
            found.append(Step(section.split("\n")[0], _file(CLIENT, read), tuple(checks)))
    return found


def written(folder: Path, text: str) -> Path:
    """Write the environment, and this text as the client, to a folder. Returns the program."""
    (folder / CLIENT).write_text(text, encoding="utf-8")
    program = folder / ENVIRONMENT
    program.write_text(_file(ENVIRONMENT, _page()), encoding="utf-8")
    return program


def _page() -> str:
    return PAGE.read_text(encoding="utf-8")


def _file(name: str, page: str) -> str:
    return "\n\n".join(block.text for block in blocks(page) if block.about == f"fragment: {name}") + "\n"
