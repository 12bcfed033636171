"""What `docs/how-to/write_a_client.md` shows: the files, and the client as it stands after each step.

Rule of the page: the first block of Ruby is the environment, and the others, one after another, are the client. A list item
that is a piece of code alone is the name of a check that passes after this step.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from tests.docs.pages import blocks
from tests.system.stage.processes import ROOT

PAGE = ROOT / "docs" / "how-to" / "write_a_client.md"
CHECK = re.compile(r"^- `([^`]+)`$", re.MULTILINE)


class Step(NamedTuple):
    """The client after a step of the page."""

    title: str
    client: str
    checks: tuple[str, ...]
    """that pass from this step on"""


def shown_files() -> tuple[str, str]:
    """The environment and the whole client, as files."""
    environment, *client = _ruby(PAGE.read_text(encoding="utf-8"))
    return environment + "\n", "\n\n".join(client) + "\n"


def steps() -> list[Step]:
    """The steps with checks. A client that is not complete is closed by `end`, as the page says."""
    _, whole = shown_files()
    found: list[Step] = []
    shown: list[str] = []
    for section in PAGE.read_text(encoding="utf-8").split("\n## ")[2:]:  # the environment is step 1
        shown += _ruby(section)
        client = "\n\n".join(shown) + "\n"
        if checks := CHECK.findall(section):
            found.append(Step(section.split("\n")[0], client if client == whole else client + "end\n", tuple(checks)))
    return found


def _ruby(text: str) -> list[str]:
    return [block.text for block in blocks(text) if block.language == "ruby"]
