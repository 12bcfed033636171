"""The report: one HTML page about runs, side by side, that needs nothing but a browser.

The law: the page is one file. It asks the network for nothing and runs no script (its own policy forbids both), all that it
tells is read from the run folders, and text from them is escaped. The same runs give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from learner.report import accounts, sections
from learner.report.runs import group, read_run
from learner.run_folder.atomic_write import write_atomically
from protocol.errors import RunError, UsageError

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:"


def write_page(runs: Sequence[Path], out: Path) -> Path:
    """Write the page about these run folders. Raises `OurError` in one line."""
    if out.is_dir():
        raise UsageError(f"{out} is a folder; expected the file to write, as in: --out report.html")
    text = page(runs)
    try:
        write_atomically(out, lambda file: file.write(text.encode()))
    except OSError as error:
        raise RunError(f"{out} not written: {error.strerror}") from error
    return out


def page(runs: Sequence[Path]) -> str:
    """The page as text. Raises `UsageError` if one of these is not a run folder that can be read."""
    told = group([read_run(run) for run in dict.fromkeys(runs)])
    style = Path(__file__).with_name("style.css").read_text()
    body = [
        sections.head(told),
        sections.headlines(told),
        sections.curves(told),
        sections.films(told),
        sections.settings(told),
        accounts.ledgers(told),
        accounts.stages(told),
        sections.foot(told),
    ]
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="color-scheme" content="light dark">',
            f"<title>{escape(sections.title(told))}: millrace report</title>",
            f"<style>\n{style}</style>",
            "</head>",
            "<body>",
            "<main>",
            *filter(None, body),
            "</main>",
            "</body>",
            "</html>",
            "",
        ]
    )
