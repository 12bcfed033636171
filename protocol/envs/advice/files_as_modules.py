"""What to write if the path of a Python file was given where the name of a module is expected. Pure."""

from __future__ import annotations

import re

_FILE = re.compile(r"(?P<folder>.*/)?(?P<module>[^\W\d]\w*)\.py(?::(?P<name>.*))?")


def module_of_file(text: str, example: str) -> str:
    """What to write instead of `mine.py` or `mine.py:Mine`, as the end of a line; empty if `text` isn't such a path.

    `example` is a name within a module; the line shows it if `text` contains no such name.
    """
    found = _FILE.fullmatch(text)
    if found is None:
        return ""
    folder = (found["folder"] or "").removeprefix("./").rstrip("/")
    where = f", with {folder} on PYTHONPATH" if folder else ""
    return f"a file is named as a module, without .py: write {found['module']}:{found['name'] or example}{where}"
