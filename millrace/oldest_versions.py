"""Checks, when `millrace` is imported, that no installed package is too old for it. It doesn't import the packages."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from typing import NamedTuple


class Oldest(NamedTuple):
    """The oldest version of a package that millrace works with."""

    version: tuple[int, int]
    file: str
    """the package's file that contains the version"""
    asked_by: str
    """what may have required an older version, for the error message"""


OLDEST = {
    "gymnasium": Oldest((1, 1), "__init__.py", "a package of environments"),
    "numpy": Oldest((2, 0), "version.py", "another package"),  # in older versions, uint64 and int promote to float
}
VERSION = re.compile(r"""^(?:__version__|version) *= *["'](\d+\.\d+[\d.]*)""", re.MULTILINE)


class PackageTooOld(ImportError):
    """An installed package is too old for millrace."""


def check_versions() -> None:
    """Check the versions in `OLDEST`. Raises `PackageTooOld` if an older one is installed.

    On the command line, no caller could handle the error, so the process ends with one line and exit code 2.
    """
    for name, oldest in OLDEST.items():
        line = _too_old(name, oldest)
        if not line:
            continue
        # With `python -m`, argv[0] is "-m" while Python looks for the module.
        if sys.argv and Path(sys.argv[0]).name in ("-m", "millrace"):
            sys.stderr.write(f"millrace: {line}\n")
            sys.exit(2)
        raise PackageTooOld(line, name=name)


def _too_old(name: str, oldest: Oldest) -> str:
    """An error line if the installed package is too old; empty if it is new enough or isn't installed.

    The version is read from the package's source text, because `importlib.metadata` would take a third of the time of
    `import millrace`.
    """
    folder = _folder(name)
    try:
        text = "" if folder is None else (folder / oldest.file).read_text("utf-8", "replace")
    except OSError:
        text = ""
    written = VERSION.search(text)
    if written is None or tuple(map(int, written[1].split(".")[:2])) >= oldest.version:
        return ""
    wanted = ".".join(map(str, oldest.version))
    return (
        f"{name} {written[1]} is too old, perhaps because {oldest.asked_by} asked for it: pip install '{name}>={wanted}', "
        "and a version of that package that allows it; or give that package a Python of its own, as under 'An older "
        "gymnasium' in docs/how-to/third_party_environments.md"
    )


def _folder(name: str) -> Path | None:
    """The folder of the package that `import NAME` finds or has already imported; None if there is none."""
    module = sys.modules.get(name)
    spec = getattr(module, "__spec__", None) if module is not None else importlib.util.find_spec(name)
    if spec is None or not spec.submodule_search_locations:
        return None
    return Path(next(iter(spec.submodule_search_locations)))
