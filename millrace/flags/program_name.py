"""How to type this program's name in the shell that started it, for lines that say what to type next.

Rule: printed commands work when typed. `millrace` works if the shell finds this very program under that name; in a clone
whose virtual environment isn't active, it doesn't.
"""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path

NAME = "millrace"


def typed_name() -> str:
    """The name that a user types. In a program of the user, or a notebook, the plain name."""
    started = Path(sys.argv[0] if sys.argv else "")
    if started.stem == NAME:
        return NAME if _is_found_as(NAME, started) else shlex.quote(str(started))
    if (started.parent.name, started.name) == (NAME, "__main__.py"):
        python = Path(sys.executable)
        name = python.name if _is_found_as(python.name, python) else shlex.quote(str(python))
        return f"{name} -m {NAME}"
    return NAME


def _is_found_as(name: str, program: Path) -> bool:
    """Whether the shell finds this program under this name. Links are not followed: two environments may share a Python."""
    found = shutil.which(name)
    return found is not None and os.path.abspath(found) == os.path.abspath(program)
