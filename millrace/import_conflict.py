"""Finds out, when `millrace` is imported, whether other code hides its packages `learner`, `workers` or `protocol`.

Python searches the folder of the script (with `python -m`: the current folder) before the installed packages. A user's own
`learner.py` there would be imported in place of millrace's, with a confusing error later.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

PACKAGES = ("learner", "workers", "protocol")
INSTALLED_IN = Path(__file__).parents[1]
"""The folder that holds `millrace` and the packages that belong to it."""


class ImportConflict(ImportError):
    """Another module has the name of a package of millrace and would be imported in its place."""


def check_imports() -> None:
    """Check that `learner`, `workers` and `protocol` are ours, without importing them. Raises `ImportConflict`.

    With `python -m millrace`, no caller could handle the error, so the process ends with one line and exit code 2.
    """
    for name in PACKAGES:
        found = _location(name)
        if found is None or os.path.realpath(found) == os.path.realpath(INSTALLED_IN / name):
            continue
        line = f"{found} is in the way: millrace has its own package {name}; rename yours, or run from another folder"
        if sys.argv[:1] == ["-m"]:  # what `python -m` sets while it looks for the module
            sys.stderr.write(f"millrace: {line}\n")
            sys.exit(2)
        raise ImportConflict(line, name=name, path=str(found))


def _location(name: str) -> Path | None:
    """The file or folder that `import NAME` finds, or has found; None if there is none."""
    module = sys.modules.get(name)
    spec = getattr(module, "__spec__", None) if module is not None else importlib.util.find_spec(name)
    if spec is not None and spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    origin = spec.origin if spec is not None else getattr(module, "__file__", None)
    return None if origin is None else Path(origin)
