"""Paths of the user that may begin with `~`, the home folder of this user, or `~NAME`, that of another.

Rule: a home folder that is not known is one line, as for an unknown user or a container without one.
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
