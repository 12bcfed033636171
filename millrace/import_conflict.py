"""Finds out, when `millrace` is imported, whether it can work with what Python finds in place of what it needs.

Other code may hide its packages `learner`, `workers` or `protocol`, and gymnasium may be too old.

Python searches the folder of the script (with `python -m`: the current folder) before the installed packages. A user's own
`learner.py` there would be imported in place of millrace's, with a confusing error later.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from pathlib import Path
from typing import NoReturn

PACKAGES = ("learner", "workers", "protocol")
INSTALLED_IN = Path(__file__).parents[1]
"""The folder that holds `millrace` and the packages that belong to it."""
OLDEST_GYMNASIUM = (1, 1)
VERSION = re.compile(r"""^__version__ *= *["'](\d+\.\d+[\d.]*)""", re.MULTILINE)


class ImportConflict(ImportError):
    """Another module has the name of a package of millrace and would be imported in its place, or gymnasium is too old."""


def check_imports() -> None:
    """Check that `learner`, `workers` and `protocol` are ours, and gymnasium's version. Raises `ImportConflict`.

    Nothing is imported for it.

    On the command line, no caller could handle the error, so the process ends with one line and exit code 2.
    """
    for name in PACKAGES:
        found = _location(name)
        if found is None or os.path.realpath(found) == os.path.realpath(INSTALLED_IN / name):
            continue
        _refuse(
            f"{found} is in the way: millrace has its own package {name}; rename yours, or run from another folder",
            name,
            found,
        )
    if too_old := _gymnasium_too_old():
        _refuse(too_old, "gymnasium", None)


def _refuse(line: str, name: str, found: Path | None) -> NoReturn:
    # With `python -m`, argv[0] is "-m" while it looks for the module.
    if sys.argv and Path(sys.argv[0]).name in ("-m", "millrace"):
        sys.stderr.write(f"millrace: {line}\n")
        sys.exit(2)
    raise ImportConflict(line, name=name, path=None if found is None else str(found))


def _gymnasium_too_old() -> str:
    """A line if the installed gymnasium is too old; else nothing, also if there is none.

    Its version is read in its source text: `importlib.metadata` takes a third of the time of `import millrace`.
    """
    folder = _location("gymnasium")
    try:
        text = "" if folder is None else (folder / "__init__.py").read_text("utf-8", "replace")
    except OSError:
        text = ""
    found = VERSION.search(text)
    if found is None or tuple(map(int, found[1].split(".")[:2])) >= OLDEST_GYMNASIUM:
        return ""
    version = found[1]
    oldest = ".".join(map(str, OLDEST_GYMNASIUM))
    return (
        f"gymnasium {version} is too old, perhaps because a package of environments asked for it: pip install "
        f"'gymnasium>={oldest}', and a version of that package that allows it"
    )


def _location(name: str) -> Path | None:
    """The file or folder that `import NAME` finds, or has found; None if there is none."""
    module = sys.modules.get(name)
    spec = getattr(module, "__spec__", None) if module is not None else importlib.util.find_spec(name)
    if spec is not None and spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    origin = spec.origin if spec is not None else getattr(module, "__file__", None)
    return None if origin is None else Path(origin)
