"""Paths that may begin with `~`, this user's home folder, or `~NAME`, another user's.

Rule: if the home folder is unknown, because the user doesn't exist or the container has none, the error is one line.
"""

from __future__ import annotations

from pathlib import Path

from millrace.protocol.errors import UsageError


def expanded(path: str | Path, what: str) -> Path:
    """The path with `~` expanded. Raises `UsageError`, in which `what` names the path, if the home folder is not known."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise UsageError(f"{what} {path}: this home folder is not known here; give the whole path") from error
