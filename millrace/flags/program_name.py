"""The name by which the user can start this program in a shell, for lines that say what to type next.

Rule: printed commands work when the user types them. `millrace` works only if the shell finds this very program under that
name, which it doesn't in a clone whose virtual environment isn't active.
"""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path

NAME = "millrace"


def typed_name() -> str:
    """The name to type. In the user's own program or a notebook, this is plain `millrace`."""
    started = Path(sys.argv[0] if sys.argv else "")
    if started.stem == NAME:
        return NAME if _is_found_as(NAME, started) else shlex.quote(str(started))
    if (started.parent.name, started.name) == (NAME, "__main__.py"):
        python = Path(sys.executable)
        name = python.name if _is_found_as(python.name, python) else shlex.quote(str(python))
        return f"{name} -m {NAME}"
    return NAME


def _is_found_as(name: str, program: Path) -> bool:
    """Whether the shell finds this program under this name.

    Links aren't followed, because the Pythons of two environments may be links to the same file.
    """
    found = shutil.which(name)
    return found is not None and os.path.abspath(found) == os.path.abspath(program)
