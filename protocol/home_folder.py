"""Paths that may begin with `~`, the home folder of this user, or `~NAME`, the home folder of another.

Rule: an unknown home folder, of an unknown user or in a container without one, is an error of one line.
"""

from __future__ import annotations

from pathlib import Path

from millrace.protocol.errors import UsageError


def expanded(path: str | Path, what: str) -> Path:
    """The path without `~`. `what` names it in the error: `UsageError` if the home folder is not known."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise UsageError(f"{what} {path}: this home folder is not known here; give the whole path") from error
