"""The versions of millrace, and of what decides its results."""

from __future__ import annotations

import platform
from contextlib import suppress
from functools import cache
from importlib import metadata

DISTRIBUTIONS = {"millrace": "millrace-rl", "torch": "torch", "gymnasium": "gymnasium", "numpy": "numpy"}
"""Name of the installed distribution, by import name."""


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide results, by import name; without those not installed."""
    found = {"python": platform.python_version()}
    for name, distribution in DISTRIBUTIONS.items():
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(distribution)
    return found
