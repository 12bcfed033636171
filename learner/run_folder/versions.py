"""The versions of millrace, and of what decides its results."""

from __future__ import annotations

import platform
from contextlib import suppress
from functools import cache
from importlib import metadata


@cache
def versions() -> dict[str, str]:
    """Of millrace, Python and the packages that decide results, by name."""
    found = {"python": platform.python_version()}
    for package in ("millrace", "torch", "gymnasium", "numpy"):
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found
