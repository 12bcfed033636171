"""Building blocks of the page's sections, as HTML text. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from millrace.extras.monitoring.report.charts import MINUS
from millrace.learner.run_folder.sentences import return_in_words


def document(title: str, head: Sequence[str], main: str) -> str:
    """A whole page. `head` (elements for the policy, style and script) and `main` are HTML; `title` is text."""
    first = "\n".join(head)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
{first}
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
</head>
<body>
<main>
{main}
</main>
</body>
</html>
"""


def section(name: str, about: str, content: str, key: str = "") -> str:
    """A section of the page with a heading. `content` is HTML; `name` and `about` are text; `key` is its id."""
    introduction = f"<p>{escape(about)}</p>" if about else ""
    named = f' id="{key}"' if key else ""
    return f"<section{named}><h2>{escape(name)}</h2>{introduction}{content}</section>"


def return_text(value: float) -> str:
    """A return as text, with a typographic minus sign."""
    return return_in_words(value).replace("-", MINUS)
