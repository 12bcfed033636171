"""Finds out, when `millrace` is imported, whether it can work with what Python finds in place of what it needs.

Other code may hide its packages `learner`, `workers` or `protocol`, and gymnasium or numpy may be too old.

Python searches the folder of the script (with `python -m`: the current folder) before the installed packages. A user's own
`learner.py` there would be imported in place of millrace's, with a confusing error later.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from pathlib import Path
from typing import NamedTuple, NoReturn

PACKAGES = ("learner", "workers", "protocol")
INSTALLED_IN = Path(__file__).parents[1]
"""The folder that holds `millrace` and the packages that belong to it."""


class Oldest(NamedTuple):
    """The oldest version of a package that millrace works with."""

    version: tuple[int, int]
    file: str
    """the file of the package that has its version"""
    asked_by: str
    """who may have asked for an older one"""


OLDEST = {
    "gymnasium": Oldest((1, 1), "__init__.py", "a package of environments"),
    "numpy": Oldest((2, 0), "version.py", "another package"),  # before, a uint64 and an int together were a float
}
VERSION = re.compile(r"""^(?:__version__|version) *= *["'](\d+\.\d+[\d.]*)""", re.MULTILINE)


class ImportConflict(ImportError):
    """Another module has the name of a package of millrace and would be imported in its place, or a package is too old."""


def check_imports() -> None:
    """Check that `learner`, `workers` and `protocol` are ours, and the versions in `OLDEST`. Raises `ImportConflict`.

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
    for name, oldest in OLDEST.items():
        if too_old := _too_old(name, oldest):
            _refuse(too_old, name, None)


def _refuse(line: str, name: str, found: Path | None) -> NoReturn:
    # With `python -m`, argv[0] is "-m" while it looks for the module.
    if sys.argv and Path(sys.argv[0]).name in ("-m", "millrace"):
        sys.stderr.write(f"millrace: {line}\n")
        sys.exit(2)
    raise ImportConflict(line, name=name, path=None if found is None else str(found))


def _too_old(name: str, oldest: Oldest) -> str:
    """A line if the installed package is too old; else nothing, also if there is none.

    Its version is read in its source text: `importlib.metadata` takes a third of the time of `import millrace`.
    """
    folder = _location(name)
    try:
        text = "" if folder is None else (folder / oldest.file).read_text("utf-8", "replace")
    except OSError:
        text = ""
    found = VERSION.search(text)
    if found is None or tuple(map(int, found[1].split(".")[:2])) >= oldest.version:
        return ""
    wanted = ".".join(map(str, oldest.version))
    return (
        f"{name} {found[1]} is too old, perhaps because {oldest.asked_by} asked for it: pip install '{name}>={wanted}', "
        "and a version of that package that allows it; or give that package a Python of its own, as under 'An older "
        "gymnasium' in docs/how-to/third_party_environments.md"
    )


def _location(name: str) -> Path | None:
    """The file or folder that `import NAME` finds, or has found; None if there is none."""
    module = sys.modules.get(name)
    spec = getattr(module, "__spec__", None) if module is not None else importlib.util.find_spec(name)
    if spec is not None and spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    origin = spec.origin if spec is not None else getattr(module, "__file__", None)
    return None if origin is None else Path(origin)
